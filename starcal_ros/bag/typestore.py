"""Message types for bags: those of ROS 2 Jazzy and of starcal, as rosbags types."""

from __future__ import annotations

import functools
import os
from pathlib import Path
import sys
from typing import Any

from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore

from starcal_ros.errors import BagError
from starcal_ros.messages.types import (
    Message,
)


def make_message(type_name: str, /, **fields: Any) -> Message:
    """Return a rosbags message: the ``make`` argument of the functions in `messages`."""
    return typestore().types[type_name](**fields)


@functools.lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Types of ROS 2 Jazzy and of starcal."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = _definitions_folder()
    for path in sorted(folder.glob('*.msg')):
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
    candidates = [Path(__file__).parents[2] / 'msg']
    candidates += [Path(prefix) / 'share/starcal/msg' for prefix in prefixes if prefix]
    for folder in candidates:
        if (folder / 'StarObservations.msg').is_file():
            return folder
    raise BagError(f'the starcal .msg files are not installed in {candidates[-1]}')


@functools.lru_cache(maxsize=64)
def typestore_of(type_name: str, definition: str) -> Typestore:
    """Types by the definition in a bag, whose writer may be another version; else `typestore`."""
    store = get_typestore(Stores.EMPTY)
    # A definition may be empty, in another language or damaged: no common base class.
    try:
        store.register(get_types_from_msg(definition, type_name))
    except Exception:
        return typestore()
    return store
