# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attacks by bags: definitions of messages, channels without one, names that act on a terminal."""

from __future__ import annotations

from pathlib import Path
import random
import tempfile

from mcap.writer import Writer

from bench import attack_sample as sample
from bench.attack_row import AttackRow
from starcal_ros.bag.typestore import described
from starcal_ros.messages.types import OBSERVATIONS_TYPE

_HEAD = b'\0\1\0\0'  # of CDR, little-endian
_END = '=' * 80
_ALLOWED = (0, 2, 3)


def rows(quick: bool) -> list[AttackRow]:
    """Rows for hostile bags."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'bag.mcap'
        return [
            definitions(path),
            changed_definitions(path, 50 if quick else 2000),
            names(path),
        ]


def write_bag(
    path: Path,
    definition: str | bytes,
    type_name: str = OBSERVATIONS_TYPE,
    data: bytes = _HEAD + b'\1' * 400,
    topic: str = '/observations',
    encodings: tuple[str, str] = ('ros2msg', 'cdr'),
    schema: int | None = None,
) -> None:
    """Write three messages under a definition; ``schema`` 0 for a channel without one."""
    content = definition if isinstance(definition, bytes) else definition.encode()
    with path.open('wb') as stream:
        writer = Writer(stream)
        writer.start('ros2')
        if schema is None:
            schema = writer.register_schema(type_name, encodings[0], content)
        channel = writer.register_channel(topic, encodings[1], schema, {})
        for k in range(3):
            writer.add_message(channel, k, data, k)
        writer.finish()  # type: ignore[no-untyped-call]


def _inspected(path: Path) -> str:
    status, said = sample.tool('inspect', path)
    assert status in _ALLOWED, status
    return said


def definitions(path: Path) -> AttackRow:
    """Definitions that are huge, contain themselves, or are other text."""
    tally = sample.Tally('definitions')
    for name, definition in _DEFINITIONS.items():
        with tally.attempt(name):
            write_bag(path, definition)
            _inspected(path)
            write_bag(path, definition, data=_HEAD + b'\xff' * 4)
            _inspected(path)
    with tally.attempt('no schema'):
        write_bag(path, '', schema=0)
        _inspected(path)
    with tally.attempt('not CDR'):
        write_bag(path, '{}', encodings=('jsonschema', 'json'))
        _inspected(path)
    with tally.attempt('type of ROS'):
        write_bag(path, 'float64[4294967295] x\n', 'sensor_msgs/msg/Image')
        _inspected(path)
    return AttackRow(
        'bags with huge, recursive or false definitions, or none',
        tally.tried,
        tally.survived,
        0,
        0,
    )


def _nested(count: int, suffix: str = '', fields: int = 1) -> str:
    parts = ['A0 x\n']
    for k in range(count):
        lines = ''.join(f'A{k + 1}{suffix} x{i}\n' for i in range(fields))
        parts.append(f'{_END}\nMSG: starcal/A{k}\n{lines}')
    return ''.join([*parts, f'{_END}\nMSG: starcal/A{count}\nint8 x\n'])


_DEFINITIONS: dict[str, str | bytes] = {
    'numbers': 'float64[4294967295] x\n',
    'strings': 'string[1000000000] x\n',
    'strings, by a bound': 'string<=99999999999999999999999 x\n',
    'strings of strings': 'string[] x\n',
    'records': f'Foo[1000000000] x\n{_END}\nMSG: starcal/Foo\nint8 a\n',
    'empty records': f'Foo[] x\n{_END}\nMSG: starcal/Foo\nint8 X=1\n',
    'empty records of ROS': 'std_msgs/Empty[] x\n',
    'records of ROS': 'std_msgs/Empty[9999] x\n',
    'itself': 'StarObservations x\n',
    'itself by another': f'Foo x\n{_END}\nMSG: starcal/Foo\nstarcal/StarObservations y\n',
    'deep': _nested(3000),
    'wide': _nested(8, '[1000]'),
    'doubling': _nested(22, fields=2),
    'long': 'int8 a\n' * 200_000,
    'no text': b'\xff\xfe\0\0' * 50,
    'empty': '',
    'code in a name': "int8 x);print('run')\n",
    'keywords': 'int8 class\nint8 lambda\nint8 self\nint8 __init__\n',
    'unknown type': 'float128 x\nUnknown y\n',
    'brackets': 'int8 X=' + '(' * 5000,
    'digits': 'int8 X=' + '9' * 100_000,
    'no header': 'int8 x\n',
    'header of another type': 'int8 header\n',
    'width of another type': 'std_msgs/Header header\nstring width\n',
}


def changed_definitions(path: Path, count: int) -> AttackRow:
    """The definition of this version with lines changed, over bytes of a message."""
    tally = sample.Tally('changed definitions')
    draw = random.Random(16)
    lines = described(OBSERVATIONS_TYPE)[0].splitlines()
    types = ('int8', 'string', 'float64[]', 'float64[3]', 'string[]', 'bool[<=4]', 'wstring', 'x')
    for k in range(count):
        changed = list(lines)
        for _ in range(draw.randint(1, 4)):
            place = draw.randrange(len(changed))
            kind, _, rest = changed[place].partition(' ')
            changed[place] = draw.choice(
                ['', f'{draw.choice(types)} {rest}', changed[draw.randrange(len(changed))],
                 kind, f'{kind} {rest[::-1]}', changed[place] + '[9]']
            )  # fmt: skip
        data = _HEAD + draw.choice([bytes(400), draw.randbytes(400), b'\xff' * 60])
        with tally.attempt(k):
            write_bag(path, '\n'.join(changed), data=data)
            _inspected(path)
    return AttackRow('bags with changed definitions', tally.tried, tally.survived, 0, 0)


def names(path: Path) -> AttackRow:
    """Topics and types whose names act on a terminal are printed with escapes."""
    tally, wrong = sample.Tally('names'), 0
    for text in (
        '\x1b]0;title\x07', '\x1b[2J\x1b[H', '\x9b31m', '\r\n\r\n', '\u202eevil', '\u2028',
        '\x08' * 9, '\x7f', '\x00', "X'); print('run'); ('", '', 'a/b/c/d', '../../etc/passwd',
        'x' * 10_000,
    ):  # fmt: skip
        for type_name, topic in (
            (f'a/msg/{text}', '/t'), (OBSERVATIONS_TYPE, f'/{text}'),
            (f'starcal/msg/{text}', '/t'), (text, text),
        ):  # fmt: skip
            with tally.attempt((type_name[:40], topic[:40])):
                write_bag(path, 'int8 x\n', type_name, topic=topic)
                said = _inspected(path)
                wrong += any(not c.isprintable() and c != '\n' for c in said)
    return AttackRow(
        'names of topics and types that act on a terminal', tally.tried, tally.survived, 0, wrong
    )
