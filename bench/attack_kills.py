"""Kills of each sub-command at random instants: inputs unchanged, outputs whole, old or absent."""

from __future__ import annotations

from collections.abc import Mapping
import contextlib
from dataclasses import dataclass, field
import hashlib
import io
import json
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

from bench.attack_row import AttackRow
from starcal_ros.bag import reader
from starcal_ros.cli import entry_point, main
from starcal_ros.errors import StarcalError
from starcal_ros.products.calibration_json import read_calibration

BAG = Path(__file__).parents[1] / 'bags' / 'tiny'
_SLOWEST_S = 300.0
_TIMES, _TIMES_QUICK = 200, 4


@dataclass(frozen=True)
class Command:
    """
    A sub-command to kill.

    ``arguments`` are in a folder that holds ``in/``, the inputs, and ``out/``.  ``is_repeatable``:
    whether each run writes the same bytes; if not, outputs are checked by reading them.
    """

    name: str
    arguments: tuple[str, ...]
    is_repeatable: bool = True


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
    Command('inspect', ('in/bag', '--params', 'in/bag/params.yaml')),
    Command('diagnose', ('in/bag', '--params', 'in/bag/params.yaml')),
    Command('play', ('in/bag', '--rate', '5')),
    Command('demo', ('-o', 'out'), is_repeatable=False),
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
    chosen = [c for c in COMMANDS if not (quick and c.name in ('play', 'demo', 'campaign'))]
    times = _TIMES_QUICK if quick else _TIMES
    cv2.setNumThreads(0)  # threads do not survive the fork of a child
    with tempfile.TemporaryDirectory() as folder:
        make_inputs(Path(folder))
        return [killed(command, Path(folder), times) for command in chosen]


def make_inputs(folder: Path) -> None:
    """Write the inputs of the commands into ``in/``: a bag, and two calibrations of it."""
    shutil.copytree(BAG, folder / 'in/bag')
    for name in ('a', 'b'):
        files = ['--params', str(folder / 'in/bag/params.yaml'), '-o', str(folder / 'in' / name)]
        with contextlib.redirect_stdout(io.StringIO()):  # in this process: it loads the modules
            status = main.main(['calibrate', str(folder / 'in/bag'), *files])
        if status != 0:
            raise RuntimeError(f'calibrate ended with {status}')


def _arguments(command: Command, folder: Path) -> list[str]:
    """Command line with the paths of a folder."""
    is_path = {a: a.partition('/')[0] in ('in', 'out') for a in command.arguments}
    words = [str(folder / a) if is_path[a] else a for a in command.arguments]
    return [command.name, *words]


def killed(command: Command, folder: Path, times: int) -> AttackRow:
    """
    Kill a command at random instants, by SIGINT and SIGKILL in turn.

    Every second run replaces the products of an earlier one.
    """
    old = _old_outputs(command, folder)
    arguments = _arguments(command, folder)
    expected, longest_s = _whole_run(arguments, folder, old)
    inputs = _inputs(folder)
    draw = random.Random(14)
    found = _Found()
    for k in range(times):
        _restore(folder, old if k % 4 < 2 or command.name == 'report' else None)
        number = signal.SIGKILL if k % 2 else signal.SIGINT
        before = _digests(folder / 'out')
        child = Child(folder, arguments)
        ended = child.wait(draw.uniform(0.0, longest_s))
        found.finished += ended is not None
        if ended is None:
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


def _whole_run(arguments: list[str], folder: Path, old: Path) -> tuple[Mapping[str, str], float]:
    """Digests of the outputs of runs that are not killed, and the longest time that one takes."""
    _restore(folder, old)
    start_s = time.monotonic()
    child = Child(folder, arguments)
    status = child.wait(_SLOWEST_S)
    if status not in (0, 3):
        raise RuntimeError(f'{arguments[0]} ended with {status}: {child.said()[-500:]}')
    return _digests(folder / 'out'), time.monotonic() - start_s


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
) -> None:
    """Each file must be as before the run, as after a whole one, or absent."""
    after = _digests(out)
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

    def __init__(self, folder: Path, arguments: list[str]) -> None:
        self._log = folder / 'log'
        sys.stdout.flush()
        self._status: int | None = None
        self._number = os.fork()
        if self._number == 0:
            _run(arguments, self._log)
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
                time.sleep(min(0.001, max(end_s - time.monotonic(), 0.0)))
        return self._status

    def send(self, number: int) -> None:
        """Send a signal to the group."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._number, number)

    def said(self) -> str:
        """What it has printed."""
        return self._log.read_text(errors='replace') if self._log.exists() else ''


def _run(arguments: list[str], log: Path) -> None:
    """In the forked process: run the tool and end."""
    status = 1
    try:
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
