# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Hostile values for files from outside; ``STARCAL_ATTACKS=100`` draws a hundred times as many."""

from collections.abc import Callable, Iterator
import functools
import hashlib
import json
import os
from pathlib import Path
import re
from typing import Any

from hypothesis import Phase, settings
from hypothesis import strategies as st

from starcal_ground.bags import reader, topics
from starcal_ground.bags.reader import Topics
from starcal_ground.parameter_files import read_setup
from starcal_ground.products import write_observations, write_products
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Calibration, Ensemble, StarObservations

BAG = Path(__file__).parents[1] / 'bags' / 'tiny'


def many(count: int) -> int:
    """Return the number of cases to draw where the tests draw ``count`` by default."""
    return count * int(os.environ.get('STARCAL_ATTACKS', '1'))


def drawn(count: int) -> Callable[[Any], Any]:
    """Return the hypothesis settings of a test with `many` cases."""
    return settings(max_examples=many(count), phases=[Phase.generate])


@functools.cache
def bag_setup() -> Setup:
    return read_setup(BAG / 'params.yaml')


@functools.cache
def observations() -> tuple[StarObservations, ...]:
    """Return the observations of that bag."""
    image = reader.choose_topic([BAG], 'sensor_msgs/msg/Image')
    attitude = reader.choose_topic([BAG], 'geometry_msgs/msg/QuaternionStamped')
    return tuple(topics.read([BAG], Topics(image, attitude), bag_setup()))


@functools.cache
def calibration() -> Calibration:
    """Return the calibration of that bag, which passes the gate."""
    solved = solve.solve(functools.reduce(Ensemble.add, observations(), Ensemble()), bag_setup())
    assert solved.accepted, solved.reasons
    return solved


def write_product_folder(folder: Path) -> None:
    """Write the products of that calibration, without a report."""
    folder.mkdir()
    write_products(calibration(), folder)
    write_observations(observations(), folder, 'camera')


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of the regular files below a folder by their paths; files over 100 MB left out."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob('*'))
        if path.is_file() and not path.is_symlink() and path.stat().st_size <= 100 << 20
    }


def _sparse(path: Path) -> None:
    with path.open('wb') as file:
        file.truncate(1 << 40)


NO_FILES: dict[str, Callable[[Path], object]] = {
    'pipe': os.mkfifo,
    'device': lambda path: path.symlink_to('/dev/zero'),
    'sparse': _sparse,
    'dangling link': lambda path: path.symlink_to('nothing'),
    'folder': Path.mkdir,
}
"""What may stand where a file of starcal or of a user is expected, made at a path, by name."""

_DEEP: object = json.loads('[' * 900 + ']' * 900)
_ODD: list[object] = [
    None, True, False, 0, -1, 1, 0.5, 1e300, -1e300, 1e-300, 1e20, 2**31, 2**32, 2**63, 10**20,
    10**400, float('nan'), float('inf'), '', 'x', 'y' * 5000, '\ud800', '\x1b[2J', '$\\frac{$',
    '<script>', '\0', [], {}, [[]], [0.0] * 1000, {'a': {}}, _DEEP, 'double', 'negate', 'remove',
]  # fmt: skip
CHANGES = st.lists(st.tuples(st.integers(0, 10**6), st.sampled_from(_ODD)), min_size=1, max_size=3)
"""Changes of a JSON object for `with_changes`: place and odd value of each."""


def with_changes(content: object, changes: list[tuple[int, object]]) -> object:
    """Return a copy of a JSON object with `CHANGES`; a long list has two places."""
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
        if new in ('double', 'negate') and isinstance(value, (int, float)):
            return 2 * value if new == 'double' else -value
        return new
    key, rest = path[0], path[1:]
    if isinstance(value, dict):
        if new == 'remove' and not rest:
            return {name: item for name, item in value.items() if name != key}
        return {n: _replaced(v, rest, new) if n == key else v for n, v in value.items()}
    assert isinstance(value, list)
    return [_replaced(v, rest, new) if k == key else v for k, v in enumerate(value)]


# Values that have been a traceback, a hang or a wrong number somewhere.
_TOKENS = (
    '', 'null', '~', 'true', 'yes', '0', '-0.0', '-1', '1e-6', '1e300', '-1e300', '1e999', '.nan',
    '.inf', 'NaN', 'Infinity', '2026-13-01', '2026-01-01', '12:30:45', '0x7fffffffffffffffff',
    '9' * 25, '9' * 5000, '-' + '9' * 5000, '0.' + '1' * 5000, '[]', '{}', '[[], {}]', '[' * 60,
    '{"a": ' * 60, '[' * 3000 + ']' * 3000, '"\\0"', '"\\u0000"', '"\\ud800"', '"\\udfff x"', '"',
    "'", '!!python/object/apply:os.system [x]', '!!binary aGk=', '!!int 3.5', '&a [*a]', '*a',
    '&a 1', '<<: 1', '? 1', '- 1', '|', '>', '%TAG ! x', '---', '...', '# x', '\t', '\x00',
    '\x1b[2J', 'a' * 5000, '/' * 3000, '../../etc/passwd', '\N{MINUS SIGN}1', '1' + '\u0301',
    'file:///dev/zero',
)  # fmt: skip


@st.composite
def spoilt_text(draw: st.DrawFn, base: str) -> bytes:
    """Draw a text file with up to three lines, values or runs of bytes changed."""
    lines = base.split('\n')
    token = st.one_of(
        st.sampled_from(_TOKENS),
        st.text(max_size=30),
        st.integers().map(str),
        st.floats().map(repr),
        st.floats(-100, 100).map(repr),
    )
    for _ in range(draw(st.sampled_from([1, 1, 2, 3]))):
        k = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(['value', 'number', 'key', 'double', 'drop', 'insert', 'join']))
        if how == 'value':
            comma = ',' if lines[k].endswith(',') else ''  # of JSON
            lines[k] = f'{lines[k].partition(": ")[0]}: {draw(token)}{comma}'
        elif how == 'number':
            numbers = list(re.finditer(r'-?\d[\d.e+-]*', lines[k]))
            if numbers:
                chosen = numbers[draw(st.integers(0, len(numbers) - 1))]
                lines[k] = lines[k][: chosen.start()] + draw(token) + lines[k][chosen.end() :]
        elif how == 'key':
            lines[k] = f'{draw(token)}: {lines[k].partition(": ")[2]}'
        elif how == 'double':
            lines.insert(k, lines[draw(st.integers(0, len(lines) - 1))])
        elif how == 'drop' and len(lines) > 1:
            del lines[k]
        elif how == 'insert':
            lines.insert(k, draw(token))
        else:
            lines[k] = lines[k] + draw(token)
    content = bytearray('\n'.join(lines).encode(errors='surrogatepass'))
    if draw(st.integers(0, 7)) == 0:
        del content[draw(st.integers(0, len(content))) :]
    if content and draw(st.integers(0, 7)) == 0:
        content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    return bytes(content)
