# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Kills and interrupts of each sub-command: inputs unchanged, outputs whole, old or absent.

A kill at random seldom meets a write: the output folder is looked at just before each operation on
a file in it, as a SIGKILL at that instant would leave it.  Other runs are interrupted there.
"""

from collections.abc import Callable, Iterator, Mapping
import contextlib
import dataclasses
import functools
import io
import os
from pathlib import Path
import random
import shutil
import sys
import threading

from attacks import BAG, digests, many  # type: ignore[import-not-found]
from mission_files import write_frames  # type: ignore[import-not-found]
import pytest

from starcal_ground.cli import main
from starcal_ground.cli.arguments import EXIT_INTERRUPTED
from starcal_ground.mission.trend.trend_table import Table
from starcal_ground.simulation import simulated_bag
from starcal_ground.simulation.scenario import scenario
from starcal_ground.written_files import is_marked, write_marked
from starcal_ros.errors import StarcalError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('forked_readers')]


_TIMES_AND_ATTITUDES = '--times in/frames/times.csv --attitude in/frames/attitude.csv'
COMMANDS = (
    'calibrate in/bag --params in/bag/params.yaml -o out',
    'report out',
    'lookup in/a -o out/table.csv --points 20',
    'undistort in/a in/frames/*.png -o out/straight',
    'simulate --scenario tiny --seed=3 --images=3 -o out/sim',
    'export in/a --to spice --spacecraft-id=-999 -o out',
    f'import --images in/frames/*.png {_TIMES_AND_ATTITUDES} -o out/sim',
    'trend in -o out',
)
"""Sub-commands to kill in a folder that holds ``in/``, the inputs, and ``out/``."""
each_command = pytest.mark.parametrize('command', COMMANDS, ids=lambda line: line.split()[0])
_OPERATIONS = ('open', 'os.rename', 'os.remove', 'os.rmdir', 'os.mkdir', 'os.truncate', 'os.link')
Look = Callable[[], None]
_watched: list[tuple[str, Look]] = []
_of_thread = threading.local()


def _before_operation(event: str, arguments: tuple[object, ...]) -> None:
    """Audit hook of Python, which cannot be removed; it looks at a watched folder."""
    is_looking = getattr(_of_thread, 'is_looking', False)  # a look opens files itself
    if not _watched or is_looking or event not in _OPERATIONS:
        return
    folder, look = _watched[0]
    if not str(arguments[0]).startswith(folder):
        return
    if event == 'open' and not int(str(arguments[2])) & (os.O_WRONLY | os.O_RDWR):
        return
    _of_thread.is_looking = True
    try:
        look()
    finally:
        _of_thread.is_looking = False


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory, few_images: Path) -> Path:
    """A folder with the inputs in ``in/``: a bag, its images, a calibration of it."""
    folder = tmp_path_factory.mktemp('kills')
    sys.addaudithook(_before_operation)
    # With three images a run has fewer thumbnails than with ten, and the same other files.
    shutil.copytree(few_images, folder / 'in/bag')
    write_frames(folder / 'in/frames', 2)
    with contextlib.redirect_stdout(io.StringIO()):
        line = 'calibrate in/bag --params in/bag/params.yaml -o in/a'
        assert _run(line, folder, lambda: None) == 0
    return folder


def _run(command: str, folder: Path, look: Look) -> int:
    """Exit status of a command that calls a function before each operation on its outputs."""
    line = [
        str(folder / word) if word.partition('/')[0] in ('in', 'out') else word
        for word in command.split()
    ]
    _watched.append((str(folder / 'out'), look))
    try:
        return main.main(line)
    finally:
        _watched.clear()


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _cut_in_run(
    command: str, folder: Path, earlier: Path | None, expected: Mapping[str, str]
) -> list[str]:
    """`_cut_outputs` before each operation of a run beside earlier products."""
    _restore(folder, earlier)
    before, cut = digests(folder / 'out'), list[str]()

    def look() -> None:
        with contextlib.suppress(FileNotFoundError):  # renamed by another thread, which looks too
            cut.extend(_cut_outputs(command, folder, before, expected))

    _run(command, folder, look)
    return cut


@each_command
def test_outputs_are_old_or_whole_before_each_operation(command, folder) -> None:
    old, expected, operations = _whole_run(command, folder)
    assert operations > 1
    assert not _cut_in_run(command, folder, old, expected)
    if command != 'report out':
        assert not _cut_in_run(command, folder, None, expected)


@each_command
def test_an_interrupt_is_one_line_and_leaves_all_files_sound(command, folder, capsys) -> None:
    """Runs that replace the products of an earlier one."""
    old, expected, operations = _whole_run(command, folder)
    inputs, draw = _inputs(folder), random.Random(14)
    for _ in range(many(2)):
        _restore(folder, old)
        before = digests(folder / 'out')
        countdown = iter(range(draw.randrange(operations), -1, -1))

        def interrupt(countdown: Iterator[int] = countdown) -> None:
            if _is_main_thread() and next(countdown, None) == 0:
                raise KeyboardInterrupt

        capsys.readouterr()
        assert _run(command, folder, interrupt) == EXIT_INTERRUPTED
        assert capsys.readouterr().err == 'starcal: interrupted\n'
        assert _inputs(folder) == inputs
        assert not _cut_outputs(command, folder, before, expected)


def _old_outputs(command: str, folder: Path) -> Path:
    """Folder with products of an earlier run, other ones than those of the next."""
    old = folder / f'old_{command.split()[0]}'
    old.mkdir()
    if command == 'report out':
        shutil.copytree(folder / 'in/a', old, dirs_exist_ok=True)
        write_marked(old / 'report.html', 'an older page')
    elif command.startswith('simulate'):
        made = dataclasses.replace(scenario('tiny', seed=4), image_count=3)
        simulated_bag.write_bag(made, old / 'sim')
    else:
        shutil.copytree(folder / 'in/a/thumbnails', old / 'thumbnails')
        names = [p.name for p in (folder / 'in/a').iterdir() if p.is_file()]
        for name in (*names, 'table.csv'):
            write_marked(old / name, f'an older {name}')
    return old


@functools.cache
def _whole_run(command: str, folder: Path) -> tuple[Path, Mapping[str, str], int]:
    """Older products, digests of those of a run that ends, and its operations in this thread."""
    old = _old_outputs(command, folder)
    _restore(folder, old)
    found: list[bool] = []
    assert _run(command, folder, lambda: found.append(_is_main_thread())) in (0, 3)
    return old, digests(folder / 'out'), sum(found)


def _restore(folder: Path, old: Path | None) -> None:
    shutil.rmtree(folder / 'out', ignore_errors=True)
    if old is None:
        (folder / 'out').mkdir()
    else:
        shutil.copytree(old, folder / 'out')


def _cut_outputs(
    command: str, folder: Path, before: Mapping[str, str], expected: Mapping[str, str]
) -> list[str]:
    """Outputs that are neither old, nor as after a whole run, nor absent."""
    out, cut = folder / 'out', []
    after = digests(out)
    for name, digest in after.items():
        if name.endswith(('.part', '.log', '-journal')) or digest == before.get(name):
            continue
        # Each run writes the same bytes but those of a trend, which are read.
        is_read = name.startswith('trend.')
        sound = _reads(out / name) if is_read else digest == expected.get(name)
        cut += [] if sound else [f'{name} is neither old nor whole']
    # A thumbnail of an earlier calibration may be gone, a product never is.
    return cut + [f'{n} is gone' for n in before if n not in after and n[:11] != 'thumbnails/']


def _reads(path: Path) -> bool:
    """True if a page or a table of a trend can be read to its end."""
    if path.suffix == '.html':
        with path.open('rb') as page:
            return is_marked(page)
    try:
        Table(path.parent).rows()
    except StarcalError:
        return False
    return True


def _inputs(folder: Path) -> dict[str, str]:
    return {**digests(folder / 'in'), **digests(BAG)}
