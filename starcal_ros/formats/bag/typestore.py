# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Message types for bags: those of ROS 2, and starcal's own, as rosbags types."""

from __future__ import annotations

import contextlib
import functools
import os
from pathlib import Path
import sys
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from starcal_ros.errors import BagError
from starcal_ros.formats.messages.message_codec import Message

_MOST_CHARACTERS = 1 << 16  # the largest definition of starcal has 4,718


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
    Types by the definition in a bag, if another version of starcal wrote it; else `typestore`.

    A definition that `check_definition` refuses is not taken: the message is then decoded as one
    of this version, which mostly fails.
    """
    own = typestore()
    is_own = type_name.startswith('starcal/') and type_name in own.types
    if not is_own or definition == described(type_name)[0]:
        return own
    # The exceptions of an invalid definition have no common base class.
    with contextlib.suppress(Exception):
        definitions = check_definition(type_name, definition)
        store = get_typestore(Stores.EMPTY)
        store.register(definitions)
        return store
    return own


def check_definition(type_name: str, definition: str) -> dict[str, Any]:
    """
    Types of a definition that differs from that of this version in its fields alone.

    Code is generated from it.  Fields may lack, and others may be added that are numbers, texts or
    lists of them without a fixed length.  Raises ValueError for any other difference, and
    exceptions of any class for what is no definition.
    """
    if len(definition) > _MOST_CHARACTERS:
        raise ValueError(f'longer than {_MOST_CHARACTERS} characters')
    definitions, known_types = get_types_from_msg(definition, type_name), typestore().fielddefs
    for name, (_, fields) in definitions.items():
        if name not in known_types:
            raise ValueError(f'{name} is no type of this version')
        known = dict(known_types[name][1])
        # A list of items without a byte could be read for ever.
        if not fields or ('header' in known and 'header' not in dict(fields)):
            raise ValueError(f'{name} has no header, or no fields')
        for field, kind in fields:
            node, content = kind
            item = content[0][0] if node == Nodetype.SEQUENCE else node
            if kind != known.get(field, kind) or (field not in known and item != Nodetype.BASE):
                raise ValueError(f'{name}.{field} has another type')
    return definitions
