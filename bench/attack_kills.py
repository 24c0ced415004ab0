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
from dataclasses import dataclass, field
import hashlib
import io
import itertools
import json
import math
import os
from pathlib import Path
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback

import cv2

from bench import graph
from bench.attack_row import AttackRow
from starcal_ros.bag import reader
from starcal_ros.cli import entry_point, main
from starcal_ros.errors import StarcalError
from starcal_ros.products.calibration_json import read_calibration
from starcal_ros.records import Image

BAG = Path(__file__).parents[1] / 'bags' / 'tiny'
_SLOWEST_S = 300.0
_TIMES, _TIMES_QUICK = 200, 4


@dataclass(frozen=True)
class Command:
    """
    A sub-command to kill.

    ``arguments`` are in a folder that holds ``in/``, the inputs, and ``out/``.  ``is_repeatable``:
    whether each run writes the same bytes; if not, outputs are checked by reading them.
    ``starts_nodes``: it waits for other processes, so instants are drawn by the clock.
    """

    name: str
    arguments: tuple[str, ...]
    is_repeatable: bool = True
    starts_nodes: bool = False


COMMANDS = (
    Command('calibrate', ('in/bag', '--params', 'in/bag/params.yaml', '-o', 'out')),
    Command('report', ('out',)),
    Command('compare', ('in/a', 'in/b', '-o', 'out/difference.png')),
    Command('lookup', ('in/a', '-o', 'out/table.csv', '--points', '100')),
    Command('simulate', ('--scenario', 'tiny', '--seed', '3', '-o', 'out/sim')),
    Command(
        'campaign',
        ('table1', '--trials', '2', '--tracker', '10', '--workers', '0', '-o', 'out'),
    ),
    Command('export', ('in/a', '--to', 'spice', '--spacecraft-id=-999', '-o', 'out')),
    Command(
        'import',
        (
            *('--images', 'in/frames/*.png', '--times', 'in/frames/times.csv'),
            *('--attitude', 'in/frames/attitude.csv', '-o', 'out/sim'),
        ),
    ),
    Command('trend', ('in', '-o', 'out'), is_repeatable=False),
    Command('inspect', ('in/bag', '--params', 'in/bag/params.yaml')),
    Command('diagnose', ('in/bag', '--params', 'in/bag/params.yaml')),
    Command('play', ('in/bag', '--rate', '5'), starts_nodes=True),
    Command('demo', ('-o', 'out'), is_repeatable=False, starts_nodes=True),
)


@dataclass
class _Found:
    """What is found after the kills of a command."""

    tried: int = 0
    tracebacks: int = 0
    hangs: int = 0
    changed_inputs: set[str] = field(default_factory=set)
    cut_outputs: list[str] = field(default_factory=list)
    finished: int = 0
    unfinished_files: int = 0


def rows(quick: bool) -> list[AttackRow]:
    """Rows for the sub-commands; in the short form without those that start nodes."""
    chosen = [c for c in COMMANDS if not (quick and (c.starts_nodes or c.name == 'campaign'))]
    writing = [c for c in chosen if 'out' in ' '.join(c.arguments) and not c.starts_nodes]
    times = _TIMES_QUICK if quick else _TIMES
    cv2.setNumThreads(0)  # threads do not survive the fork of a child
    with tempfile.TemporaryDirectory() as folder:
        make_inputs(Path(folder))
        return [
            *(watched(command, Path(folder)) for command in writing),
            *(killed(command, Path(folder), times) for command in chosen),
        ]


def make_inputs(folder: Path) -> None:
    """Write the inputs of the commands into ``in/``: a bag, its images, two calibrations of it."""
    shutil.copytree(BAG, folder / 'in/bag')
    _make_frames(folder / 'in/frames')
    for name in ('a', 'b'):
        files = ['--params', str(folder / 'in/bag/params.yaml'), '-o', str(folder / 'in' / name)]
        with contextlib.redirect_stdout(io.StringIO()):  # in this process: it loads the modules
            status = main.main(['calibrate', str(folder / 'in/bag'), *files])
        if status != 0:
            raise RuntimeError(f'calibrate ended with {status}')


def _make_frames(folder: Path) -> None:
    """Write three images as PNG, their times, and attitudes about them."""
    folder.mkdir()
    images = itertools.islice(reader.read_images([BAG], '/opnav/image_raw', 0.0), 3)
    times, attitudes = ['file,time_ns'], ['time_ns,qx,qy,qz,qw']
    for k, image in enumerate(images):
        assert isinstance(image, Image)  # of a sound bag
        cv2.imwrite(str(folder / f'{k}.png'), image.pixels)
        times.append(f'{k}.png,{image.time_ns}')
        attitudes += [f'{image.time_ns + after_ns},0,0,0,1' for after_ns in (-(10**8), 10**8)]
    (folder / 'times.csv').write_text('\n'.join(times) + '\n')
    (folder / 'attitude.csv').write_text('\n'.join(attitudes) + '\n')


def _arguments(command: Command, folder: Path) -> list[str]:
    """Command line with the paths of a folder."""
    is_path = {a: a.partition('/')[0] in ('in', 'out') for a in command.arguments}
    words = [str(folder / a) if is_path[a] else a for a in command.arguments]
    return [command.name, *words]


def watched(command: Command, folder: Path) -> AttackRow:
    """Look at the output folder before each operation on a file in it, in two whole runs."""
    old, arguments = _old_outputs(command, folder), _arguments(command, folder)
    expected, _ = _whole_run(command, folder, old)
    found = _Found()
    for earlier in (old,) if command.name == 'report' else (old, None):
        _restore(folder, earlier)
        before = _digests(folder / 'out')
        states = folder / 'states'
        Child(folder, arguments, states).wait()
        for line in states.read_text().splitlines():
            found.tried += 1
            _check_outputs(command, folder / 'out', before, expected, found, json.loads(line))
    for text in found.cut_outputs:
        print(f'{command.name}: {text}')
    return AttackRow(
        f'starcal {command.name}: output folder before each file operation',
        found.tried,
        found.tried,
        len(found.cut_outputs),
        0,
    )


def killed(command: Command, folder: Path, times: int, until_s: float = math.inf) -> AttackRow:
    """
    Kill a command at random instants, by SIGINT and SIGKILL in turn.

    Every second pair of runs replaces the products of an earlier one.  No run begins after
    ``until_s``, by the monotonic clock.
    """
    old, arguments = _old_outputs(command, folder), _arguments(command, folder)
    expected, longest_s = _whole_run(command, folder, old)
    inputs = _inputs(folder)
    draw = random.Random(14)
    found = _Found()
    for k in range(times):
        if time.monotonic() > until_s:
            break
        _restore(folder, old if k % 4 < 2 or command.name == 'report' else None)
        number = signal.SIGKILL if k % 2 else signal.SIGINT
        before = _digests(folder / 'out')
        child = Child(folder, arguments)
        instant_s = draw.uniform(0.0, longest_s)
        if command.starts_nodes:
            ended = child.wait(instant_s) is not None
        else:
            ended = child.wait_for_processor(instant_s)
        found.finished += ended
        if not ended:
            child.send(number)
            found.hangs += child.wait(_SLOWEST_S) is None
        child.send(signal.SIGKILL)  # nodes that the demo has started
        found.tried += 1
        said = child.said()
        found.tracebacks += 'Traceback' in said
        if 'Traceback' in said:
            print(said[-2000:])
        found.changed_inputs |= _changed(inputs, _inputs(folder))
        _check_outputs(command, folder / 'out', before, expected, found)
    bad = found.tracebacks + found.hangs
    for text in [*sorted(found.changed_inputs), *found.cut_outputs]:
        print(f'{command.name}: {text}')
    note = (
        f'{found.finished} had finished before; unfinished files beside after '
        f'{found.unfinished_files} kills'
    )
    return AttackRow(
        f'starcal {command.name}: SIGINT and SIGKILL at random instants',
        found.tried,
        found.tried - bad,
        len(found.changed_inputs) + len(found.cut_outputs),
        0,
        note,
    )


def _old_outputs(command: Command, folder: Path) -> Path:
    """Folder with products of an earlier run, other ones than those of the next."""
    old = folder / f'old_{command.name}'
    shutil.rmtree(old, ignore_errors=True)
    old.mkdir()
    if command.name == 'report':
        shutil.copytree(folder / 'in/a', old, dirs_exist_ok=True)
        (old / 'report.html').write_text('an older page')
    elif command.name == 'simulate':
        arguments = ['simulate', '--scenario', 'tiny', '--seed', '4', '-o', str(old / 'sim')]
        Child(folder, arguments).wait()
    else:
        shutil.copytree(folder / 'in/a/thumbnails', old / 'thumbnails')
        names = [p.name for p in (folder / 'in/a').iterdir() if p.is_file()]
        for name in (*names, 'difference.png', 'table.csv', 'table1.json', 'table1.png'):
            (old / name).write_text(f'an older {name}')
    return old


def _whole_run(command: Command, folder: Path, old: Path) -> tuple[Mapping[str, str], float]:
    """Digests of the outputs of a run that is not killed, and its time, s."""
    _restore(folder, old)
    start_s, before = time.monotonic(), os.times()
    child = Child(folder, _arguments(command, folder))
    status = child.wait(_SLOWEST_S)
    if status not in (0, 3):
        raise RuntimeError(f'{command.name} ended with {status}: {child.said()[-500:]}')
    after = os.times()
    processor_s = after.children_user + after.children_system
    processor_s -= before.children_user + before.children_system
    took_s = time.monotonic() - start_s if command.starts_nodes else processor_s
    return _digests(folder / 'out'), took_s


def _restore(folder: Path, old: Path | None) -> None:
    shutil.rmtree(folder / 'out', ignore_errors=True)
    if old is None:
        (folder / 'out').mkdir()
    else:
        shutil.copytree(old, folder / 'out')


def _check_outputs(
    command: Command,
    out: Path,
    before: Mapping[str, str],
    expected: Mapping[str, str],
    found: _Found,
    state: Mapping[str, str] | None = None,
) -> None:
    """Each file, now or in a recorded state, must be old, as after a whole run, or absent."""
    after = _digests(out) if state is None else state
    parts = [name for name in after if name.endswith('.part')]
    found.unfinished_files += bool(parts)
    for name, digest in after.items():
        if name in parts or name.endswith('.log') or digest == before.get(name):
            continue
        if command.is_repeatable:
            sound = digest == expected.get(name)
        else:
            sound = _reads(out / name)
        if not sound:
            found.cut_outputs.append(f'{name} is neither old nor whole')
    for name in before:
        # A thumbnail of an earlier calibration may be gone, a product never is.
        if name not in after and not name.startswith('thumbnails/'):
            found.cut_outputs.append(f'{name} is gone')


def _reads(path: Path) -> bool:
    """Whether a product can be read to its end."""
    damage: list[str] = []
    try:
        if path.name == 'calibration.json':
            read_calibration(path)
        elif path.suffix == '.json':
            json.loads(path.read_text())
        elif path.suffix == '.mcap':
            for _ in reader.read_raw([path], on_damage=damage.append):
                pass
        elif path.suffix == '.html':
            return path.read_text().rstrip().endswith('</html>')
        else:
            return path.stat().st_size > 0
    except (StarcalError, ValueError, OSError):
        return False
    return not damage


def _inputs(folder: Path) -> dict[str, str]:
    return {**_digests(folder / 'in'), **_digests(BAG)}


def _digests(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob('*'))
        if path.is_file()
    }


def _changed(before: Mapping[str, str], after: Mapping[str, str]) -> set[str]:
    names = before.keys() | after.keys()
    return {f'input {name}' for name in names if before.get(name) != after.get(name)}


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

    def wait(self, timeout_s: float = _SLOWEST_S) -> int | None:
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
        while self.wait(0.001) is None:
            if graph.processor_s(self._number) >= processor_s:
                return False
        return True

    def send(self, number: int) -> None:
        """Send a signal to the group."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._number, number)

    def said(self) -> str:
        """What it has printed."""
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
        lines.write(json.dumps(_digests(out)) + '\n')
        lines.flush()
        looking = False

    sys.addaudithook(look)


_OPERATIONS = ('open', 'os.rename', 'os.remove', 'os.rmdir', 'os.mkdir', 'os.truncate', 'os.link')
