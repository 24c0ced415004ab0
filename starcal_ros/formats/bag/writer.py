# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records to MCAP bags, without ROS; equal records give equal bytes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import contextlib
from dataclasses import dataclass
import io
from pathlib import Path
from types import TracebackType
from typing import Any, IO, TYPE_CHECKING

from mcap.writer import CompressionType, Writer
import yaml

from starcal_ros.arrays import Floats
from starcal_ros.errors import BagError, errors_as
from starcal_ros.files import replacing
from starcal_ros.formats.bag.typestore import described, make_message, typestore
from starcal_ros.formats.messages import sensor_messages
from starcal_ros.formats.messages.message_codec import (
    ATTITUDE_TYPE,
    IMAGE_TYPE,
    OBSERVATIONS_TYPE,
    TEMPERATURE_TYPE,
    VELOCITY_TYPE,
)
from starcal_ros.formats.messages.record_messages import observations_to_message
from starcal_ros.formats.messages.sensor_messages import image_to_message
from starcal_ros.records import Image, StarObservations

if TYPE_CHECKING:
    from typing_extensions import Self

_OF_BAGS = ('metadata.yaml', '*.mcap', '*.db3')
_COMPRESSION = CompressionType.ZSTD
_CHUNK_BYTES = 4 << 20  # an image or two: lost in a crash, and held in memory by a reader


class BagWriter:
    """
    Writes records to a bag folder, or to a single file if the path ends in ``.mcap``.

    Use it in a ``with`` statement: its end replaces the file whole.  After an exception in the
    block the file that was there before is unchanged.  A folder gets a ``metadata.yaml``, a single
    file none: the one beside it may belong to another bag.  Missing folders are created.
    """

    def __init__(self, path: Path | str) -> None:
        path = Path(path)
        is_file = path.suffix == '.mcap'
        self.file = path if is_file else path / f'{path.name}_0.mcap'
        self._metadata_file = None if is_file else path / 'metadata.yaml'
        self._channels: dict[str, tuple[int, str]] = {}  # number and type by topic
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0
        self._replacing: contextlib.AbstractContextManager[IO[bytes]] | None = None
        self._writer: Any = None

    def __enter__(self) -> Self:
        """Open a temporary file in the folder of the bag."""
        with errors_as(BagError, self.file, 'written'):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._replacing = replacing(self.file)
            stream = self._replacing.__enter__()
        self._start(stream)
        return self

    def _start(self, stream: IO[bytes]) -> None:
        self._writer = Writer(stream, _CHUNK_BYTES, _COMPRESSION)
        self._writer.start('ros2', library='starcal')

    @classmethod
    def one_observation(cls, topic: str, record: StarObservations, frame_id: str) -> bytes:
        """Bytes of a complete bag with a single starcal/StarObservations."""
        stream = io.BytesIO()
        writer = cls('one.mcap')
        writer._start(stream)
        writer.write_observations(topic, record, frame_id)
        writer._writer.finish()
        return stream.getvalue()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Complete the bag and put it in its place; drop it after an exception."""
        assert self._replacing is not None  # __enter__ has set it
        if kind is not None:
            self._replacing.__exit__(kind, error, traceback)
            return
        with errors_as(BagError, self.file, 'written'):
            with contextlib.ExitStack() as stack:
                stack.push(self._replacing)
                self._writer.finish()
            if self._metadata_file is not None:
                with replacing(self._metadata_file) as file:
                    file.write(self._metadata().encode())

    def outputs(self) -> list[Path]:
        """Files of the bag to write, and those of any bag in its folder."""
        if self._metadata_file is None:
            return [self.file]
        there = [path for end in _OF_BAGS for path in self.file.parent.glob(end)]
        return [self.file, self._metadata_file, *there]

    def write_image(self, topic: str, image: Image, frame_id: str) -> None:
        """Write a sensor_msgs/Image."""
        message = image_to_message(image, frame_id, make_message)
        self._write(topic, IMAGE_TYPE, image.time_ns, message)

    def write_attitude(self, topic: str, time_ns: int, xyzw: Floats, frame_id: str) -> None:
        """Write a geometry_msgs/QuaternionStamped in the inertial frame ``frame_id``."""
        message = sensor_messages.attitude_to_message(time_ns, xyzw, frame_id, make_message)
        self._write(topic, ATTITUDE_TYPE, time_ns, message)

    def write_velocity(
        self, topic: str, time_ns: int, velocity_m_s: Floats, frame_id: str
    ) -> None:
        """Write a geometry_msgs/TwistStamped."""
        message = sensor_messages.velocity_to_message(
            time_ns, velocity_m_s, frame_id, make_message
        )
        self._write(topic, VELOCITY_TYPE, time_ns, message)

    def write_temperature(
        self, topic: str, time_ns: int, temperature_degc: float, frame_id: str
    ) -> None:
        """Write a sensor_msgs/Temperature."""
        message = sensor_messages.temperature_to_message(
            time_ns, temperature_degc, frame_id, make_message
        )
        self._write(topic, TEMPERATURE_TYPE, time_ns, message)

    def write_observations(self, topic: str, record: StarObservations, frame_id: str) -> None:
        """Write a starcal/StarObservations."""
        message = observations_to_message(record, frame_id, make_message)
        self._write(topic, OBSERVATIONS_TYPE, record.time_ns, message)

    def _write(self, topic: str, type_name: str, time_ns: int, message: object) -> None:
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
        with errors_as(BagError, self.file, 'written'):
            self._writer.add_message(
                number, time_ns, data, publish_time=time_ns, sequence=self._counts[topic]
            )
        self._counts[topic] += 1
        self._first_ns = time_ns if self._first_ns is None else min(self._first_ns, time_ns)
        self._last_ns = max(self._last_ns, time_ns)

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

    def _metadata(self) -> str:
        messages = sum(self._counts.values())
        file = FileSpan(self.file.name, self._first_ns or 0, self._last_ns, messages)
        topics = [
            TopicSummary(topic, type_name, self._counts[topic])
            for topic, (_, type_name) in self._channels.items()
        ]
        return metadata_text([file], topics)


@dataclass(frozen=True)
class FileSpan:
    """A file of a bag: name, stamps of its first and last message, number of messages."""

    name: str
    first_ns: int
    last_ns: int
    messages: int


@dataclass(frozen=True)
class TopicSummary:
    """A topic of a bag."""

    name: str
    type_name: str
    messages: int


def metadata_text(files: Sequence[FileSpan], topics: Sequence[TopicSummary]) -> str:
    """Return the content of the metadata.yaml of at least one file."""
    first_ns, last_ns = min(file.first_ns for file in files), max(file.last_ns for file in files)
    whole = FileSpan('', first_ns, last_ns, sum(file.messages for file in files))
    topic_list = [
        {
            'topic_metadata': {
                'name': topic.name,
                'type': topic.type_name,
                'serialization_format': 'cdr',
                'offered_qos_profiles': [_offered_qos()],
                'type_description_hash': typestore().hash_rihs01(topic.type_name),
            },
            'message_count': topic.messages,
        }
        for topic in topics
    ]
    information = {
        'version': 9,
        'storage_identifier': 'mcap',
        'relative_file_paths': [file.name for file in files],
        **_span(whole),
        'topics_with_message_count': topic_list,
        'compression_format': '',
        'compression_mode': '',
        'files': [{'path': file.name, **_span(file)} for file in files],
        'custom_data': None,
        'ros_distro': 'jazzy',
    }
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=True)


def _span(file: FileSpan) -> dict[str, object]:
    return {
        'starting_time': {'nanoseconds_since_epoch': file.first_ns},
        'duration': {'nanoseconds': max(file.last_ns - file.first_ns, 0)},
        'message_count': file.messages,
    }


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
