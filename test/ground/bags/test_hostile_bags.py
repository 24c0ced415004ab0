# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Hostile bags: definitions of messages, channels without one, names that act on a terminal."""

from pathlib import Path
import random
from typing import Any

from attacks import many  # type: ignore[import-not-found]
from mcap.writer import Writer
import pytest

from starcal_ground.bags import rosbag2
from starcal_ground.cli import main
from starcal_ros.formats.bag.typestore import described
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE

HEAD = b'\0\1\0\0'  # of CDR, little-endian
END = '=' * 80


def write_bag(
    path: Path,
    definition: str | bytes,
    type_name: str = OBSERVATIONS_TYPE,
    data: bytes = HEAD + b'\1' * 400,
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
        writer.finish()


def diagnose(path: Path) -> None:
    """The tool reads the bag or refuses it."""
    assert main.main(['diagnose', str(path)]) in (0, 2, 3)


def nested(count: int, fields: int = 1) -> str:
    parts = ['A0 x\n']
    for k in range(count):
        lines = ''.join(f'A{k + 1} x{i}\n' for i in range(fields))
        parts.append(f'{END}\nMSG: starcal/A{k}\n{lines}')
    return ''.join([*parts, f'{END}\nMSG: starcal/A{count}\nint8 x\n'])


DEFINITIONS: dict[str, str | bytes] = {
    'numbers': 'float64[4294967295] x\n',
    'strings, by a bound': 'string<=99999999999999999999999 x\n',
    'strings of strings': 'string[] x\n',
    'records': f'Foo[1000000000] x\n{END}\nMSG: starcal/Foo\nint8 a\n',
    'empty records': f'Foo[] x\n{END}\nMSG: starcal/Foo\nint8 X=1\n',
    'empty records of ROS': 'std_msgs/Empty[] x\n',
    'itself': 'StarObservations x\n',
    'itself by another': f'Foo x\n{END}\nMSG: starcal/Foo\nstarcal/StarObservations y\n',
    'deep': nested(3000),
    'doubling': nested(22, fields=2),
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
    'no schema': '',
    'JSON': '{}',
    'an image of numbers': 'float64[4294967295] x\n',
}
OF_ANOTHER_KIND: dict[str, dict[str, Any]] = {
    'no schema': {'schema': 0},
    'JSON': {'encodings': ('jsonschema', 'json')},
    'an image of numbers': {'type_name': 'sensor_msgs/msg/Image'},
}


@pytest.mark.parametrize('name', DEFINITIONS)
def test_huge_recursive_or_false_definitions(name, tmp_path) -> None:
    path = tmp_path / 'bag.mcap'
    for data in (HEAD + b'\1' * 400, HEAD + b'\xff' * 4):
        write_bag(path, DEFINITIONS[name], data=data, **OF_ANOTHER_KIND.get(name, {}))
        diagnose(path)


def test_changed_definitions(tmp_path) -> None:
    """The definition of this version with lines changed, over random bytes."""
    path = tmp_path / 'bag.mcap'
    draw = random.Random(16)
    lines = described(OBSERVATIONS_TYPE)[0].splitlines()
    types = ('int8', 'string', 'float64[]', 'float64[3]', 'string[]', 'bool[<=4]', 'wstring', 'x')
    for _ in range(many(50)):
        changed = list(lines)
        for _ in range(draw.randint(1, 4)):
            place = draw.randrange(len(changed))
            kind, _, rest = changed[place].partition(' ')
            changed[place] = draw.choice(
                ['', f'{draw.choice(types)} {rest}', changed[draw.randrange(len(changed))],
                 kind, f'{kind} {rest[::-1]}', changed[place] + '[9]']
            )  # fmt: skip
        data = HEAD + draw.choice([bytes(400), draw.randbytes(400), b'\xff' * 60])
        write_bag(path, '\n'.join(changed), data=data)
        diagnose(path)


@pytest.mark.parametrize(
    'text',
    [
        '\x1b]0;title\x07', '\x1b[2J\x1b[H', '\x9b31m', '\r\n\r\n', '\u202eevil', '\u2028',
        '\x08' * 9, '\x7f', '\x00', "X'); print('run'); ('", '', 'a/b/c/d', '../../etc/passwd',
        'x' * 10_000,
    ],
)  # fmt: skip
def test_names_that_act_on_a_terminal_are_escaped(text, tmp_path, capsys) -> None:
    path = tmp_path / 'bag.mcap'
    for type_name, topic in (
        (f'a/msg/{text}', '/t'),
        (OBSERVATIONS_TYPE, f'/{text}'),
        (f'starcal/msg/{text}', '/t'),
        (text, text),
    ):
        write_bag(path, 'int8 x\n', type_name, topic=topic)
        diagnose(path)
        printed = ''.join(capsys.readouterr())
        assert all(c.isprintable() or c == '\n' for c in printed)


def test_a_bag_cannot_name_any_module_to_be_imported() -> None:
    with pytest.raises(ValueError, match='no type of a message'):
        rosbag2.decode(memoryview(b''), 'xml/sax/handler')
