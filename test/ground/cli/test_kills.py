# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Kills of each sub-command: inputs unchanged, outputs whole, old or absent.

Instants are drawn from the processor time of a whole run, so that a busy machine does not move all
of them to its start.  A kill at random seldom meets a write.  So the state of the output folder is
also looked at just before each operation of a run on a file in it: that is what a SIGKILL at
that instant would leave.
"""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
import dataclasses
from dataclasses import dataclass
import functools
import io
import json
import os
from pathlib import Path
import random
import shutil
import signal
import sys
import time
import traceback

from attacks import BAG, digests, many  # type: ignore[import-not-found]
import cv2
from mission_files import write_frames  # type: ignore[import-not-found]
import pytest

from bench import graph
from starcal_ground.bags import reader
from starcal_ground.cli import entry_point, main
from starcal_ground.mission.trend.trend_table import Table
from starcal_ground.simulation import simulated_bag
from starcal_ground.simulation.scenario import scenario
from starcal_ros import files
from starcal_ros.errors import StarcalError
from starcal_ros.formats.products.product_files import read_calibration, write_atomically

SLOWEST_S = 300.0
pytestmark = [
    pytest.mark.slow,
    # Python 3.12 warns of the threads of a worker of pytest, which run on in the parent alone.
    pytest.mark.filterwarnings('ignore:.* use of fork:DeprecationWarning'),
]


@dataclass(frozen=True)
class Command:
    """
    A sub-command to kill.

    ``arguments`` are in a folder that holds ``in/``, the inputs, and ``out/``.  Each run writes
    the same bytes if ``is_repeatable``; if not, outputs are checked by reading them.
    """

    name: str
    arguments: tuple[str, ...]
    is_repeatable: bool = True


COMMANDS = (
    Command('calibrate', ('in/bag', '--params', 'in/bag/params.yaml', '-o', 'out')),
    Command('report', ('out',)),
    Command('lookup', ('in/a', '-o', 'out/table.csv', '--points', '100')),
    Command('undistort', ('in/a', 'in/frames/*.png', '-o', 'out/straight')),
    Command('simulate', ('--scenario', 'tiny', '--seed=3', '--images=3', '-o', 'out/sim')),
    Command('export', ('in/a', '--to', 'spice', '--spacecraft-id=-999', '-o', 'out')),
    Command(
        'import',
        (
            *('--images', 'in/frames/*.png', '--times', 'in/frames/times.csv'),
            *('--attitude', 'in/frames/attitude.csv', '-o', 'out/sim'),
        ),
    ),
    Command('trend', ('in', '-o', 'out'), is_repeatable=False),
    Command('diagnose', ('in/bag', '--params', 'in/bag/params.yaml')),
)


WRITING = [c for c in COMMANDS if 'out' in ' '.join(c.arguments)]


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the inputs in ``in/``: a bag, its images, two calibrations of it."""
    folder = tmp_path_factory.mktemp('kills')
    cv2.setNumThreads(0)  # threads do not survive the fork of a child
    # With three images a run has fewer thumbnails than with ten, and the same other files.
    few = dataclasses.replace(scenario('tiny'), image_count=3)
    simulated_bag.write_bag(few, folder / 'in/bag')
    write_frames(folder / 'in/frames', 2)
    files = ['--params', str(folder / 'in/bag/params.yaml'), '-o', str(folder / 'in/a')]
    with contextlib.redirect_stdout(io.StringIO()):  # in this process: it loads the modules
        assert main.main(['calibrate', str(folder / 'in/bag'), *files]) == 0
    return folder


def _arguments(command: Command, folder: Path) -> list[str]:
    """Command line with the paths of a folder."""
    is_path = {a: a.partition('/')[0] in ('in', 'out') for a in command.arguments}
    words = [str(folder / a) if is_path[a] else a for a in command.arguments]
    return [command.name, *words]


@pytest.mark.parametrize('command', WRITING, ids=lambda command: command.name)
def test_outputs_are_old_or_whole_before_each_operation(command: Command, folder: Path) -> None:
    """Look at the output folder before each operation on a file in it, in two whole runs."""
    arguments = _arguments(command, folder)
    old, expected, _ = _whole_run(command, folder)
    looked = 0
    for earlier in (old,) if command.name == 'report' else (old, None):
        _restore(folder, earlier)
        before = digests(folder / 'out')
        states = folder / 'states'
        Child(folder, arguments, states).wait()
        for line in states.read_text().splitlines():
            looked += 1
            assert not _cut_outputs(command, folder / 'out', before, expected, json.loads(line))
    assert looked > 1


@pytest.mark.parametrize('command', COMMANDS, ids=lambda command: command.name)
def test_kills_at_random(command: Command, folder: Path) -> None:
    """
    SIGINT and SIGKILL in turn: no traceback, no hang, inputs unchanged, outputs old or whole.

    Every second pair of runs replaces the products of an earlier one.
    """
    arguments = _arguments(command, folder)
    old, expected, longest_s = _whole_run(command, folder)
    inputs = _inputs(folder)
    draw = random.Random(14)
    for k in range(many(4)):
        _restore(folder, old if k % 4 < 2 or command.name == 'report' else None)
        before = digests(folder / 'out')
        child = Child(folder, arguments)
        if not child.wait_for_processor(draw.uniform(0.0, longest_s)):
            child.send(signal.SIGKILL if k % 2 else signal.SIGINT)
            assert child.wait() is not None
        assert 'Traceback' not in child.said()
        assert _inputs(folder) == inputs
        assert not _cut_outputs(command, folder / 'out', before, expected)


def _old_outputs(command: Command, folder: Path) -> Path:
    """Folder with products of an earlier run, other ones than those of the next."""
    old = folder / f'old_{command.name}'
    old.mkdir()
    if command.name == 'report':
        shutil.copytree(folder / 'in/a', old, dirs_exist_ok=True)
        write_atomically(old / 'report.html', 'an older page')
    elif command.name == 'simulate':
        made = dataclasses.replace(scenario('tiny', seed=4), image_count=3)
        simulated_bag.write_bag(made, old / 'sim')
    else:
        shutil.copytree(folder / 'in/a/thumbnails', old / 'thumbnails')
        names = [p.name for p in (folder / 'in/a').iterdir() if p.is_file()]
        for name in (*names, 'table.csv'):
            write_atomically(old / name, f'an older {name}')
    return old


@functools.cache
def _whole_run(command: Command, folder: Path) -> tuple[Path, Mapping[str, str], float]:
    """Older products, digests of those of a run that is not killed, and its processor time, s."""
    old = _old_outputs(command, folder)
    _restore(folder, old)
    before = os.times()
    child = Child(folder, _arguments(command, folder))
    status = child.wait(SLOWEST_S)
    assert status in (0, 3), child.said()
    after = os.times()
    processor_s = after.children_user + after.children_system
    processor_s -= before.children_user + before.children_system
    return old, digests(folder / 'out'), processor_s


def _restore(folder: Path, old: Path | None) -> None:
    shutil.rmtree(folder / 'out', ignore_errors=True)
    if old is None:
        (folder / 'out').mkdir()
    else:
        shutil.copytree(old, folder / 'out')


def _cut_outputs(
    command: Command,
    out: Path,
    before: Mapping[str, str],
    expected: Mapping[str, str],
    state: Mapping[str, str] | None = None,
) -> list[str]:
    """Files, now or in a recorded state, that are not old, as after a whole run, or absent."""
    after = digests(out) if state is None else state
    cut = []
    for name, digest in after.items():
        if name.endswith(('.part', '.log', '-journal')) or digest == before.get(name):
            continue
        if state is not None and not command.is_repeatable and not (out / name).exists():
            continue  # merged into another file since: a kill at random reads it while it is there
        sound = digest == expected.get(name) if command.is_repeatable else _reads(out / name)
        cut += [] if sound else [f'{name} is neither old nor whole']
    # A thumbnail of an earlier calibration may be gone, a product never is.
    return cut + [f'{n} is gone' for n in before if n not in after and n[:11] != 'thumbnails/']


def _reads(path: Path) -> bool:
    """True if a product can be read to its end."""
    damage: list[str] = []
    try:
        if path.name == 'calibration.json':
            read_calibration(path)
        elif path.suffix == '.json':
            json.loads(path.read_text())
        elif path.suffix == '.mcap':
            for _ in reader.read_raw([path], on_damage=damage.append):
                pass
        elif path.suffix == '.sqlite':
            Table(path.parent).rows()
        elif path.suffix == '.html':
            with path.open('rb') as page:
                return files.is_marked(page)
        else:
            return path.stat().st_size > 0
    except (StarcalError, ValueError, OSError):
        return False
    return not damage


def _inputs(folder: Path) -> dict[str, str]:
    return {**digests(folder / 'in'), **digests(BAG)}


class Child:
    """The tool in a forked process of its own group, without the seconds that imports take."""

    def __init__(self, folder: Path, arguments: list[str], states: Path | None = None) -> None:
        self._log = folder / 'log'
        sys.stdout.flush()
        self._status: int | None = None
        self._number = os.fork()
        if self._number == 0:
            _run(arguments, self._log, folder / 'out', states)
        with contextlib.suppress(OSError):  # it has done so itself, or has ended
            os.setpgid(self._number, self._number)

    def wait(self, timeout_s: float = SLOWEST_S) -> int | None:
        """Exit status, or None after a time."""
        end_s = time.monotonic() + timeout_s
        while self._status is None and time.monotonic() < end_s:
            number, status = os.waitpid(self._number, os.WNOHANG)
            if number:
                self._status = os.waitstatus_to_exitcode(status)
            else:
                time.sleep(min(0.005, max(end_s - time.monotonic(), 0.0)))
        return self._status

    def wait_for_processor(self, processor_s: float) -> bool:
        """Wait until it has used a processor for a time; True where it has ended before."""
        while self.wait(0.005) is None:
            if graph.processor_s(self._number) >= processor_s:
                return False
        return True

    def send(self, number: int) -> None:
        """Send a signal to the group."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._number, number)

    def said(self) -> str:
        """Return the output so far."""
        return self._log.read_text(errors='replace') if self._log.exists() else ''


def _run(arguments: list[str], log: Path, out: Path, states: Path | None) -> None:
    """In the forked process: run the tool and end."""
    status = 1
    try:
        if states is not None:
            _record_states(out, states)
        # SIGINT waits until the tool is called, as it does in a process of its own.
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        os.setpgid(0, 0)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.argv = ['starcal', *arguments]
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        status = entry_point.main()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(status)


def _record_states(out: Path, states: Path) -> None:
    """Write the digests of a folder as a line of JSON before each operation on a file in it."""
    lines = states.open('w')
    looking = False

    def look(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal looking
        if looking or event not in _OPERATIONS or not str(arguments[0]).startswith(str(out)):
            return
        if event == 'open' and not int(str(arguments[2])) & (os.O_WRONLY | os.O_RDWR):
            return
        looking = True
        lines.write(json.dumps(digests(out)) + '\n')
        lines.flush()
        looking = False

    sys.addaudithook(look)


_OPERATIONS = ('open', 'os.rename', 'os.remove', 'os.rmdir', 'os.mkdir', 'os.truncate', 'os.link')
