# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Messages of bags by the packages of a sourced ROS 2, where the wheels mcap or rosbags are absent.

rosbag2_py reads MCAP and SQLite files, rclpy decodes with the types of the workspace.  At damage
rosbag2 may end without an error, so the messages are counted.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
import contextlib
import importlib
import importlib.util
from pathlib import Path
import sys
from typing import Any

from starcal_ros.errors import BagError

SQLITE_MAGIC = b'SQLite format 3'
INSTALL = f'{sys.executable} -m pip install mcap rosbags'
_REMEDY = f'{INSTALL}, which reads what is intact of an MCAP bag'


def _is_installed(name: str) -> bool:
    with contextlib.suppress(ImportError):
        return importlib.util.find_spec(name) is not None
    return False


READS_BAGS = _is_installed('rosbag2_py') and not all(map(_is_installed, ('mcap', 'rosbags')))


def topics(file: Path) -> tuple[list[tuple[str, str, int]], int]:
    """Name, type and message count of each topic of a file, and the time of its first message."""
    metadata = _opened(file).get_metadata()
    counts = [
        (topic.topic_metadata.name, topic.topic_metadata.type, topic.message_count)
        for topic in metadata.topics_with_message_count
        if topic.message_count and topic.topic_metadata.serialization_format == 'cdr'
    ]
    if not counts:
        raise BagError(f'{file}: rosbag2 finds no message in it: if it is cut off, {_REMEDY}')
    return counts, int(metadata.starting_time.nanoseconds)


def read_messages(
    file: Path, wanted: Collection[object] | None, on_damage: Callable[[str], None]
) -> Iterator[tuple[str, bytes, int]]:
    """Topic, CDR with its header and time of the messages that are wanted (None: all)."""
    from rosbag2_py import StorageFilter

    there, _ = topics(file)
    counts = {
        name: n for name, *kind, n in there if wanted is None or {name, (name, *kind)} & {*wanted}
    }
    if not counts:
        return
    reader = _opened(file)
    reader.set_filter(StorageFilter(topics=list(counts)))
    missing = sum(counts.values())
    with contextlib.suppress(RuntimeError, MemoryError, LookupError, ValueError):  # from C++
        while reader.has_next():
            yield reader.read_next()
            missing -= 1
    if missing > 0:  # negative: a topic with two types gives more messages
        on_damage(f'{file}: damaged, rosbag2 reads only a part: {_REMEDY}')


def decode(data: memoryview, type_name: str) -> Any:
    """Message of the workspace's own type; raises an error of any class for wrong bytes."""
    package, folder, name = type_name.split('/')
    if folder != 'msg':
        raise ValueError(f'{type_name} is no type of a message')
    from rclpy.serialization import deserialize_message

    kind = getattr(importlib.import_module(f'{package}.{folder}'), name)
    return deserialize_message(bytes(data), kind)


def _opened(file: Path) -> Any:
    from rclpy.logging import LoggingSeverity, set_logger_level
    from rosbag2_py import SequentialReader

    for name in ('rosbag2_cpp', 'rosbag2_storage', 'rosbag2_storage_mcap'):
        set_logger_level(name, LoggingSeverity.FATAL)  # one line of ours reports it
    reader = SequentialReader()
    try:
        reader.open_uri(str(file))
    except RuntimeError as error:
        raise BagError(f'{file}: rosbag2 cannot open it ({error}): {_REMEDY}') from error
    return reader
