# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Messages of bags as rosbags types, those of ROS 2 and starcal's own, and MCAP of them without ROS.

Equal messages give equal bytes.
"""

from __future__ import annotations

import functools
import io
import os
from pathlib import Path
import sys
from typing import Any, IO

from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from rosbags.typesys.store import Typestore
import yaml

from starcal_ros.errors import BagError
from starcal_ros.formats.messages import message_codec, record_messages
from starcal_ros.records import StarObservations

_MOST_CHARACTERS = 1 << 16  # the largest definition of starcal has 4,718
_LONGEST_REASON = 100  # characters
_COMPRESSION = CompressionType.ZSTD
_CHUNK_BYTES = 4 << 20  # an image or two: lost in a crash, and held in memory by a reader
# The messages of telemetry and observations: all types of ROS 2 take 0.1 s (docs/experiments.md).
_FEW_TYPES = {
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id',
    'geometry_msgs/msg/Quaternion': 'float64 x\nfloat64 y\nfloat64 z\nfloat64 w',
    'geometry_msgs/msg/QuaternionStamped': 'std_msgs/Header header\nQuaternion quaternion',
    'geometry_msgs/msg/Vector3': 'float64 x\nfloat64 y\nfloat64 z',
    'geometry_msgs/msg/Twist': 'Vector3 linear\nVector3 angular',
    'geometry_msgs/msg/TwistStamped': 'std_msgs/Header header\nTwist twist',
    'sensor_msgs/msg/Temperature': (
        'std_msgs/Header header\nfloat64 temperature\nfloat64 variance'
    ),
}


def make_message(type_name: str, /, **fields: Any) -> message_codec.Message:
    """Return a rosbags message, for the functions that take a ``make``."""
    return store_with(type_name).types[type_name](**fields)


@functools.lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Types of ROS 2, those of Jazzy and Kilted alike, and starcal's own."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(_definitions_folder().glob('*.msg')):
        store.register(_own_types(path.stem))
    return store


def store_with(type_name: str) -> Typestore:
    """Return the few types that are often used if this is one of them, else `typestore`."""
    few = _few_types()
    return few if type_name in few.types else typestore()


@functools.lru_cache(maxsize=1)
def _few_types() -> Typestore:
    """Types that most commands need: made in 0.01 s, where all those of ROS 2 take 0.1 s."""
    store, types = get_typestore(Stores.EMPTY), _own_types('StarObservations')
    for name, definition in _FEW_TYPES.items():
        types |= get_types_from_msg(definition, name)
    store.register(types)
    return store


def _own_types(name: str) -> dict[str, Any]:
    text = (_definitions_folder() / f'{name}.msg').read_text()
    return dict(get_types_from_msg(text, f'starcal/msg/{name}'))


@functools.lru_cache(maxsize=64)
def described(type_name: str) -> tuple[str, str]:
    """Definition of a type with its nested types, and its RIHS01 hash."""
    store = store_with(type_name)
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return definition, store.hash_rihs01(type_name)


def _definitions_folder() -> Path:
    """Folder of starcal's .msg files: in the source tree, or in a ROS or Python prefix."""
    prefixes = [*os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    candidates = [Path(__file__).parents[3] / 'msg']
    candidates += [Path(prefix) / 'share/starcal/msg' for prefix in prefixes if prefix]
    for folder in candidates:
        if (folder / 'StarObservations.msg').is_file():
            return folder
    raise BagError(f'the starcal .msg files are not installed in {candidates[-1]}')


def typestore_of(type_name: str, definition: str) -> Typestore:
    """
    Types by the definition in a bag, if another version of starcal wrote it; else `store_with`.

    An empty definition is taken for that of this version.  Raises BagError for one that
    `check_definition` refuses.
    """
    store, why = _typestore_of(type_name, definition)
    if store is None:
        raise BagError(f'defined in the bag as no version of starcal does: {why}')
    return store


@functools.lru_cache(maxsize=64)
def _typestore_of(type_name: str, definition: str) -> tuple[Typestore | None, str]:
    """Return the types, or None and what is wrong with the definition, once for all messages."""
    own, store = store_with(type_name), get_typestore(Stores.EMPTY)
    is_own = type_name.startswith('starcal/') and type_name in own.types
    if not (is_own and definition) or definition == described(type_name)[0]:
        return own, ''
    # The exceptions of an invalid definition have no common base class.
    try:
        store.register(check_definition(type_name, definition))
        # Comments may differ, as recorders keep those of the .msg file.
        return (own if store.hash_rihs01(type_name) == described(type_name)[1] else store), ''
    except Exception as error:
        return None, ' '.join(str(error).split())[:_LONGEST_REASON]


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


def observations_bag(topic: str, record: StarObservations, frame_id: str) -> bytes:
    """Return the bytes of a complete bag with a single starcal/StarObservations."""
    kind, stream = message_codec.OBSERVATIONS_TYPE, io.BytesIO()
    message = record_messages.observations_to_message(record, frame_id, make_message)
    writer = started(stream)
    number, data = opened(writer, topic, kind), serialised(topic, kind, message)
    writer.add_message(number, record.time_ns, data, publish_time=record.time_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


def observations_in_bag(data: bytes) -> StarObservations:
    """Observations of the single message in the bytes of a bag; raises BagError for any other."""
    try:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        messages: list[Message] = []
        for record in StreamReader(io.BytesIO(data), validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                messages.append(record)
        if len(messages) != 1:
            raise BagError(f'{len(messages)} images, not one')
        schema = schemas[channels[messages[0].channel_id].schema_id]
        if schema.name != message_codec.OBSERVATIONS_TYPE:
            raise BagError(f'{schema.name} is not {message_codec.OBSERVATIONS_TYPE}')
        store = typestore_of(schema.name, schema.data.decode())
        message = store.deserialize_cdr(messages[0].data, schema.name)
    except BagError:
        raise
    # Damaged bytes are parsed as an arbitrary record: the exceptions have no common base class.
    except Exception as error:
        raise BagError(f'damaged: {type(error).__name__}: {error}') from error
    return record_messages.checked_observations(message)


def started(stream: IO[bytes]) -> Writer:
    """Return a writer of MCAP to a stream, complete after its ``finish``."""
    writer = Writer(stream, _CHUNK_BYTES, _COMPRESSION)
    writer.start('ros2', library='starcal')
    return writer


def opened(writer: Writer, topic: str, type_name: str) -> int:
    """Return the number of a new channel for the messages of a topic."""
    definition, type_hash = described(type_name)
    schema_id = writer.register_schema(type_name, 'ros2msg', definition.encode())
    metadata = {
        'offered_qos_profiles': yaml.safe_dump([offered_qos()], sort_keys=False),
        'topic_type_hash': type_hash,
    }
    return writer.register_channel(topic, 'cdr', schema_id, metadata)


def serialised(topic: str, type_name: str, message: object) -> bytes:
    """Return the CDR of a message of `make_message`; raises BagError for one that has none."""
    try:
        return bytes(store_with(type_name).serialize_cdr(message, type_name))
    # The exceptions of a value that its field cannot hold have no common base class.
    except Exception as error:
        raise BagError(f'{topic}: a {type_name} cannot be written: {error}') from error


def offered_qos() -> dict[str, object]:
    """Return the QoS of the topics, reliable and volatile, in the notation of rosbag2."""

    def forever() -> dict[str, int]:
        return {'sec': 9223372036, 'nsec': 854775807}

    return {
        'history': 'keep_last',
        'depth': 10,
        'reliability': 'reliable',
        'durability': 'volatile',
        'deadline': forever(),
        'lifespan': forever(),
        'liveliness': 'automatic',
        'liveliness_lease_duration': forever(),
        'avoid_ros_namespace_conventions': False,
    }
