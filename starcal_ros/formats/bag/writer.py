# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages to MCAP, without ROS; equal messages give equal bytes."""

from __future__ import annotations

import io
from typing import IO

from mcap.writer import CompressionType, Writer
import yaml

from starcal_ros.errors import BagError
from starcal_ros.formats.bag.typestore import described, make_message, typestore
from starcal_ros.formats.messages import message_codec, record_messages
from starcal_ros.records import StarObservations

_COMPRESSION = CompressionType.ZSTD
_CHUNK_BYTES = 4 << 20  # an image or two: lost in a crash, and held in memory by a reader


def observations_bag(topic: str, record: StarObservations, frame_id: str) -> bytes:
    """Return the bytes of a complete bag with a single starcal/StarObservations."""
    kind, stream = message_codec.OBSERVATIONS_TYPE, io.BytesIO()
    message = record_messages.observations_to_message(record, frame_id, make_message)
    writer = started(stream)
    number, data = opened(writer, topic, kind), serialised(topic, kind, message)
    writer.add_message(number, record.time_ns, data, publish_time=record.time_ns)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


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
        return bytes(typestore().serialize_cdr(message, type_name))
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
