# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The sound files that attacks change: a bag, its calibration and its observations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
import functools
import hashlib
import io
import json
from pathlib import Path
import signal
import time

from hypothesis import given, HealthCheck, Phase, seed, settings
from hypothesis import strategies as st

from starcal_ros.bag import reader
from starcal_ros.cli import main
from starcal_ros.pipeline import observe, solve
from starcal_ros.pipeline.setup import read_setup, Setup
from starcal_ros.records import Calibration, Ensemble, StarObservations

BAG = Path(__file__).parents[1] / 'bags' / 'tiny'
_MOST_BYTES = 100 << 20  # of a sound file; some attacks make larger ones
# An attack that takes longer counts as a hang. Waiting for a FIFO takes no processor time; by the
# clock the limit is longer, as the machine may be busy.
LONGEST_PROCESSOR_S, LONGEST_S = 5.0, 60.0


@functools.cache
def setup() -> Setup:
    """Setup of the bag in the repository."""
    return read_setup(BAG / 'params.yaml')


@functools.cache
def observations() -> tuple[StarObservations, ...]:
    """Observations of that bag."""
    image = reader.choose_topic([BAG], 'sensor_msgs/msg/Image')
    attitude = reader.choose_topic([BAG], 'geometry_msgs/msg/QuaternionStamped')
    return tuple(observe.observe_bag([BAG], image, attitude, setup()))


@functools.cache
def calibration() -> Calibration:
    """The calibration of that bag, which the gate accepts."""
    found = solve.solve(functools.reduce(Ensemble.add, observations(), Ensemble()), setup())
    assert found.accepted, found.reasons
    return found


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of the regular files below a folder, by their paths in it; huge ones left out."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob('*'))
        if path.is_file() and not path.is_symlink() and path.stat().st_size <= _MOST_BYTES
    }


def changed(before: Mapping[str, str], after: Mapping[str, str]) -> list[str]:
    """Files of before that are gone or have another content."""
    return [name for name, digest in before.items() if after.get(name) != digest]


def tool(*arguments: object) -> tuple[int, str]:
    """Exit status of the tool in this process, and its output; an exception passes through."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            status = main.main([str(argument) for argument in arguments])
        except SystemExit as error:  # argparse's way out
            status = int(error.code or 0)
    return status, output.getvalue()


class Tally:
    """Counts attempts, those that end in time without an exception, and prints the others."""

    def __init__(self, attack: str) -> None:
        self._attack = attack
        self.tried = self.survived = 0

    @contextlib.contextmanager
    def attempt(self, what: object) -> Iterator[None]:
        """Count one attempt; an exception inside counts and goes no further."""
        self.tried += 1
        before = signal.signal(signal.SIGALRM, _time_out)
        signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
        start_s = time.process_time()
        try:
            yield
            took_s = time.process_time() - start_s
            if took_s > LONGEST_PROCESSOR_S:
                raise TimeoutError(f'{took_s:.1f} s of processor time')
        except Exception as error:
            print(f'{self._attack}: {what!s:.300}: {type(error).__name__}: {error!s:.300}')
        else:
            self.survived += 1
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)


def _time_out(_number: int, _frame: object) -> None:
    raise TimeoutError(f'{LONGEST_S:g} s')


_DEEP: object = json.loads('[' * 900 + ']' * 900)
_ODD: list[object] = [
    None, True, False, 0, -1, 1, 0.5, 1e300, -1e300, 1e-300, 1e20, 2**31, 2**32, 2**63, 10**20,
    10**400, float('nan'), float('inf'), '', 'x', 'y' * 5000, '\ud800', '\x1b[2J', '$\\frac{$',
    '<script>', '\0', [], {}, [[]], [0.0] * 1000, {'a': {}}, _DEEP,
]  # fmt: skip


def odd_changes(count: int, number: int, take: Callable[[list[tuple[int, object]]], None]) -> None:
    """
    Call a function with changes of a JSON object, ``count`` times: place and value of each.

    A value is odd, or one of ``'double'``, ``'negate'`` and ``'remove'``.
    """
    value = st.one_of(st.sampled_from(_ODD), st.sampled_from(['double', 'negate', 'remove']))
    changes = st.lists(st.tuples(st.integers(0, 10**6), value), min_size=1, max_size=3)
    left = count
    for series in range(count):  # hypothesis stops early without new examples
        if left <= 0:
            return

        @seed(1000 * number + series)
        @settings(
            max_examples=left,
            database=None,
            deadline=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(changes)
        def draw(found: list[tuple[int, object]]) -> None:
            nonlocal left
            if left > 0:
                left -= 1
                take(found)

        draw()


def with_changes(content: object, changes: list[tuple[int, object]]) -> object:
    """A copy of a JSON object with changes of `odd_changes`; long lists have one place."""
    for place, value in changes:
        places = list(_places(content, ()))
        content = _replaced(content, places[place % len(places)], value)
    return content


def _places(value: object, path: tuple[object, ...]) -> Iterator[tuple[object, ...]]:
    if path:
        yield path
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _places(item, (*path, key))
    elif isinstance(value, list) and value and len(path) < 8:
        for k in {0, len(value) - 1}:
            yield from _places(value[k], (*path, k))


def _replaced(value: object, path: tuple[object, ...], new: object) -> object:
    if not path:
        if new == 'double' and isinstance(value, (int, float)):
            return 2 * value
        if new == 'negate' and isinstance(value, (int, float)):
            return -value
        return new
    key, rest = path[0], path[1:]
    if isinstance(value, dict):
        if new == 'remove' and not rest:
            return {name: item for name, item in value.items() if name != key}
        return {n: _replaced(v, rest, new) if n == key else v for n, v in value.items()}
    assert isinstance(value, list)
    return [_replaced(v, rest, new) if k == key else v for k, v in enumerate(value)]
