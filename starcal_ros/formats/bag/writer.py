# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages to MCAP, without ROS; equal messages give equal bytes."""

from __future__ import annotations

from collections import Counter
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


class MessageWriter:
    """Writes messages to a stream as MCAP, complete after `finish`."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._channels: dict[str, tuple[int, str]] = {}  # number and type by topic
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._writer = Writer(stream, _CHUNK_BYTES, _COMPRESSION)
        self._writer.start('ros2', library='starcal')

    def write(self, topic: str, type_name: str, time_ns: int, message: object) -> None:
        """Write a message of `make_message`; raises BagError for one that cannot be serialised."""
        number, of_topic = self._channels.get(topic) or self._open(topic, type_name)
        if of_topic != type_name:
            raise ValueError(f'topic: {topic} holds {of_topic}, not {type_name}')
        try:
            data = bytes(typestore().serialize_cdr(message, type_name))
        # The exceptions of a value that its field cannot hold have no common base class.
        except Exception as error:
            raise BagError(f'{topic}: a {type_name} cannot be written: {error}') from error
        # A recording time is not negative; the stamp in the message is written as it is.
        time_ns = max(time_ns, 0)
        self._writer.add_message(
            number, time_ns, data, publish_time=time_ns, sequence=self._counts[topic]
        )
        self._counts[topic] += 1
        self._first_ns = time_ns if self._first_ns is None else min(self._first_ns, time_ns)
        self._last_ns = max(self._last_ns, time_ns)

    def finish(self) -> None:
        """Write the summary and the end of the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _open(self, topic: str, type_name: str) -> tuple[int, str]:
        definition, type_hash = described(type_name)
        schema_id = self._writer.register_schema(type_name, 'ros2msg', definition.encode())
        metadata = {
            'offered_qos_profiles': yaml.safe_dump([_offered_qos()], sort_keys=False),
            'topic_type_hash': type_hash,
        }
        number = self._writer.register_channel(topic, 'cdr', schema_id, metadata)
        self._channels[topic] = number, type_name
        return number, type_name

    def metadata(self, name: str) -> str:
        """Return the content of the metadata.yaml of the file of that name."""
        first_ns = self._first_ns or 0

        def span() -> dict[str, object]:  # twice the same object would be an alias in YAML
            return {
                'starting_time': {'nanoseconds_since_epoch': first_ns},
                'duration': {'nanoseconds': max(self._last_ns - first_ns, 0)},
                'message_count': sum(self._counts.values()),
            }

        topics = [
            {
                'topic_metadata': {
                    'name': topic,
                    'type': type_name,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': [_offered_qos()],
                    'type_description_hash': typestore().hash_rihs01(type_name),
                },
                'message_count': self._counts[topic],
            }
            for topic, (_, type_name) in self._channels.items()
        ]
        information = {
            'version': 9,
            'storage_identifier': 'mcap',
            'relative_file_paths': [name],
            **span(),
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'files': [{'path': name, **span()}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }
        return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=True)


def observations_bag(topic: str, record: StarObservations, frame_id: str) -> bytes:
    """Return the bytes of a complete bag with a single starcal/StarObservations."""
    stream = io.BytesIO()
    writer = MessageWriter(stream)
    message = record_messages.observations_to_message(record, frame_id, make_message)
    writer.write(topic, message_codec.OBSERVATIONS_TYPE, record.time_ns, message)
    writer.finish()
    return stream.getvalue()


def _offered_qos() -> dict[str, object]:
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
