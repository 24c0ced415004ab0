# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records to bags: images, telemetry and observations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
import contextlib
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import IO, TYPE_CHECKING

import numpy as np
import yaml

from starcal_ground.written_files import replacing
from starcal_ros.arrays import Floats
from starcal_ros.errors import BagError, errors_as
from starcal_ros.formats.bag import typestore as bag_types
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.formats.messages import sensor_messages
from starcal_ros.formats.messages.record_messages import observations_to_message
from starcal_ros.records import Image, StarObservations

if TYPE_CHECKING:
    from typing_extensions import Self

ORIGIN = 'starcal_origin'
"""Metadata record of a bag with the entries of the provenance that the bag carries."""
_OF_BAGS = ('metadata.yaml', '*.mcap', '*.db3')


class BagWriter:
    """
    Writes records to a bag folder, or to a single file if the path ends in ``.mcap``.

    Use it in a ``with`` statement: its end replaces the file whole.  After an exception in the
    block the file that was there before is unchanged.  A folder gets a ``metadata.yaml``, a single
    file none: the one beside it may belong to another bag.  Missing folders are created.

    ``origin`` is the metadata `ORIGIN` of the bag, as ``bags.reader.origin_of`` reads it.
    """

    def __init__(self, path: Path | str, origin: Mapping[str, str] = MappingProxyType({})) -> None:
        path = Path(path)
        self._origin = dict(origin)
        is_file = path.suffix == '.mcap'
        self.file = path if is_file else path / f'{path.name}_0.mcap'
        self._metadata_file = None if is_file else path / 'metadata.yaml'
        self._replacing: contextlib.AbstractContextManager[IO[bytes]] | None = None
        self._channels: dict[str, tuple[int, str]] = {}  # number and type by topic
        self._counts: Counter[str] = Counter()
        self._first_ns: int | None = None
        self._last_ns = 0

    def __enter__(self) -> Self:
        """Open a temporary file in the folder of the bag."""
        with errors_as(BagError, self.file, 'written'):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._replacing = replacing(self.file)
            self._writer = bag_types.started(self._replacing.__enter__())
            if self._origin:  # before the messages: it is read without them
                self._writer.add_metadata(ORIGIN, self._origin)
        return self

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
                self._writer.finish()  # type: ignore[no-untyped-call]
            if self._metadata_file is not None:
                with replacing(self._metadata_file) as file:
                    file.write(self._metadata().encode())

    def outputs(self) -> list[Path]:
        """Files of the bag to write, and those of any bag in its folder."""
        if self._metadata_file is None:
            return [self.file]
        there = [path for end in _OF_BAGS for path in self.file.parent.glob(end)]
        return [self.file, self._metadata_file, *there]

    def write(self, topic: str, type_name: str, time_ns: int, message: codec.Message) -> None:
        """Write a message; raises BagError where the disk is full or a field cannot hold it."""
        # A recording time is not negative; the stamp in the message is written as it is.
        time_ns = max(time_ns, 0)
        with errors_as(BagError, self.file, 'written'):
            number, of_topic = self._channels.get(topic) or self._open(topic, type_name)
            if of_topic != type_name:
                raise ValueError(f'topic: {topic} holds {of_topic}, not {type_name}')
            data = bag_types.serialised(topic, type_name, message)
            self._writer.add_message(
                number, time_ns, data, publish_time=time_ns, sequence=self._counts[topic]
            )
        self._counts[topic] += 1
        self._first_ns = time_ns if self._first_ns is None else min(self._first_ns, time_ns)
        self._last_ns = max(self._last_ns, time_ns)

    def _open(self, topic: str, type_name: str) -> tuple[int, str]:
        self._channels[topic] = bag_types.opened(self._writer, topic, type_name), type_name
        return self._channels[topic]

    def _metadata(self) -> str:
        """Content of the metadata.yaml."""
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
                    'offered_qos_profiles': [bag_types.offered_qos()],
                    'type_description_hash': bag_types.described(type_name)[1],
                },
                'message_count': self._counts[topic],
            }
            for topic, (_, type_name) in self._channels.items()
        ]
        information = {
            'version': 9,
            'storage_identifier': 'mcap',
            'relative_file_paths': [self.file.name],
            **span(),
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'files': [{'path': self.file.name, **span()}],
            'custom_data': None,
            'ros_distro': 'jazzy',
        }
        return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=True)

    def write_image(self, topic: str, image: Image, frame_id: str) -> None:
        """Write a sensor_msgs/Image."""
        message = image_to_message(image, frame_id, bag_types.make_message)
        self.write(topic, codec.IMAGE_TYPE, image.time_ns, message)

    def write_attitude(self, topic: str, time_ns: int, xyzw: Floats, frame_id: str) -> None:
        """Write a geometry_msgs/QuaternionStamped in the inertial frame ``frame_id``."""
        message = attitude_to_message(time_ns, xyzw, frame_id, bag_types.make_message)
        self.write(topic, codec.ATTITUDE_TYPE, time_ns, message)

    def write_velocity(
        self, topic: str, time_ns: int, velocity_m_s: Floats, frame_id: str
    ) -> None:
        """Write a geometry_msgs/TwistStamped."""
        message = velocity_to_message(time_ns, velocity_m_s, frame_id, bag_types.make_message)
        self.write(topic, codec.VELOCITY_TYPE, time_ns, message)

    def write_temperature(
        self, topic: str, time_ns: int, temperature_degc: float, frame_id: str
    ) -> None:
        """Write a sensor_msgs/Temperature."""
        message = temperature_to_message(
            time_ns, temperature_degc, frame_id, bag_types.make_message
        )
        self.write(topic, codec.TEMPERATURE_TYPE, time_ns, message)

    def write_observations(self, topic: str, record: StarObservations, frame_id: str) -> None:
        """Write a starcal/StarObservations."""
        message = observations_to_message(record, frame_id, bag_types.make_message)
        self.write(topic, codec.OBSERVATIONS_TYPE, record.time_ns, message)


def image_to_message(image: Image, frame_id: str, make: codec.Make) -> codec.Message:
    """Return a sensor_msgs/Image, mono8 or mono16 in the byte order of this machine."""
    return sensor_messages.image_to_message(image.time_ns, image.pixels, frame_id, make)


def attitude_to_message(
    time_ns: int, quaternion_xyzw: Floats, frame_id: str, make: codec.Make
) -> codec.Message:
    """Return a geometry_msgs/QuaternionStamped; ``frame_id`` is the inertial frame."""
    return make(
        codec.ATTITUDE_TYPE,
        header=codec.make_header(time_ns, frame_id, make),
        quaternion=codec.quaternion_to_message(quaternion_xyzw, make),
    )


def velocity_to_message(
    time_ns: int, velocity_m_s: Floats, frame_id: str, make: codec.Make
) -> codec.Message:
    """Return a geometry_msgs/TwistStamped without rotation."""
    return make(
        codec.VELOCITY_TYPE,
        header=codec.make_header(time_ns, frame_id, make),
        twist=make(
            'geometry_msgs/msg/Twist',
            linear=codec.vector_to_message(velocity_m_s, make),
            angular=codec.vector_to_message(np.zeros(3), make),
        ),
    )


def temperature_to_message(
    time_ns: int, temperature_degc: float, frame_id: str, make: codec.Make
) -> codec.Message:
    """Return a sensor_msgs/Temperature; its variance is 0, which means unknown in ROS."""
    return make(
        codec.TEMPERATURE_TYPE,
        header=codec.make_header(time_ns, frame_id, make),
        temperature=float(temperature_degc),
        variance=0.0,
    )
