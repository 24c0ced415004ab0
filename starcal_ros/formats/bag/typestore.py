# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Message types for bags: those of ROS 2, and starcal's own, as rosbags types."""

from __future__ import annotations

from collections.abc import Mapping
import functools
import os
from pathlib import Path
import re
import sys
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from starcal_ros.errors import BagError
from starcal_ros.formats.messages.message_codec import Message

_TYPE_NAME = re.compile(r'[A-Za-z]\w*/msg/[A-Za-z]\w*', re.ASCII)
# The largest definition of starcal has 4,718 characters, its longest array nine items.
_MOST_CHARACTERS, _MOST_ITEMS = 1 << 16, 1000
_COUNT = re.compile(r'(\d+)\s*\]')


def make_message(type_name: str, /, **fields: Any) -> Message:
    """Return a rosbags message: the ``make`` argument of the functions in `messages`."""
    return typestore().types[type_name](**fields)


@functools.lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Types of ROS 2, those of Jazzy and Kilted alike, and starcal's own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(_definitions_folder().glob('*.msg')):
        store.register(get_types_from_msg(path.read_text(), f'starcal/msg/{path.stem}'))
    return store


@functools.lru_cache(maxsize=64)
def described(type_name: str) -> tuple[str, str]:
    """Definition of a type with its nested types, and its RIHS01 hash."""
    definition, _ = typestore().generate_msgdef(type_name, ros_version=2)
    return definition, typestore().hash_rihs01(type_name)


def _definitions_folder() -> Path:
    """Folder of starcal's .msg files: in the source tree, or in a ROS or Python prefix."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    candidates = [Path(__file__).parents[3] / 'msg']
    candidates += [Path(prefix) / 'share/starcal/msg' for prefix in prefixes if prefix]
    for folder in candidates:
        if (folder / 'StarObservations.msg').is_file():
            return folder
    raise BagError(f'the starcal .msg files are not installed in {candidates[-1]}')


@functools.lru_cache(maxsize=64)
def typestore_of(type_name: str, definition: str) -> Typestore:
    """
    Types by the definition in a bag, whose writer may be another version; else `typestore`.

    Raises BagError when the definition is invalid and the type is not one of `typestore`.
    """
    try:
        return typestore_with(type_name, definition)
    # The exceptions of an invalid definition have no common base class.
    except Exception as error:
        if type_name not in typestore().types:
            raise BagError(
                f'{type_name:.60}: its definition in the bag: {error!s:.100}'
            ) from error
        return typestore()


def typestore_with(type_name: str, definition: str) -> Typestore:
    """
    Types with the bag's own definition of one: another version may have written the bag.

    Raises ValueError when the definition is too large, since code is generated from it, and
    exceptions of any class when it is invalid.
    """
    if not _TYPE_NAME.fullmatch(type_name):
        raise ValueError('not a type name')
    if len(definition) > _MOST_CHARACTERS:
        raise ValueError(f'longer than {_MOST_CHARACTERS} characters')
    for count in _COUNT.findall(definition):
        if len(count) > 9 or int(count) > _MOST_ITEMS:
            raise ValueError(f'an array of more than {_MOST_ITEMS} items')
    definitions = get_types_from_msg(definition, type_name)
    _count_items(type_name, definitions, {})
    for name, (_, fields) in definitions.items():
        _check_fields(name, dict(fields))
    store = get_typestore(Stores.EMPTY)
    store.register(definitions)
    return store


def _check_fields(name: str, fields: Mapping[str, Any]) -> None:
    """
    Compare the fields of a definition with those of this version, which may have others.

    Raises ValueError when a field of the same name has another type, or the header is missing.
    """
    if name not in typestore().fielddefs:
        return
    known = dict(typestore().fielddefs[name][1])
    if 'header' in known and 'header' not in fields:
        raise ValueError(f'{name} has no header')
    for field in fields.keys() & known.keys():
        if _without_lengths(fields[field]) != _without_lengths(known[field]):
            raise ValueError(f'{name}.{field} has another type')


def _without_lengths(kind: Any) -> Any:
    node, content = kind
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return ('list', _without_lengths(content[0]))
    return content if node == Nodetype.NAME else content[0]


def _count_items(name: str, types: Mapping[str, Any], known: dict[str, int]) -> int:
    """
    Smallest number of items of a message of a type; types that others define count as one.

    Raises ValueError for a type that contains itself, that has no fields, or that has too many
    items: reading one would take for ever.
    """
    if name not in types:
        return 1
    if name in known:
        if not known[name]:
            raise ValueError(f'{name} contains itself')
        return known[name]
    known[name] = 0
    _, fields = types[name]
    known[name] = sum(_items_of(kind, types, known) for _, kind in fields)
    if not 0 < known[name] <= _MOST_ITEMS:
        raise ValueError(f'{name} has {known[name]} items')
    return known[name]


def _items_of(kind: Any, types: Mapping[str, Any], known: dict[str, int]) -> int:
    node, content = kind
    if node == Nodetype.NAME:
        return _count_items(content, types, known)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        item, count = content
        each = _items_of(item, types, known)
        return each * int(count) if node == Nodetype.ARRAY else 1
    return 1
