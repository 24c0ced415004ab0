# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records to bags: images, telemetry and observations."""

from __future__ import annotations

import contextlib
from pathlib import Path
import sys
from types import TracebackType
from typing import IO, TYPE_CHECKING

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.errors import BagError, errors_as
from starcal_ros.files import replacing
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.bag.writer import MessageWriter
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.formats.messages.record_messages import observations_to_message
from starcal_ros.records import Image, StarObservations

if TYPE_CHECKING:
    from typing_extensions import Self

_OF_BAGS = ('metadata.yaml', '*.mcap', '*.db3')


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
        self._replacing: contextlib.AbstractContextManager[IO[bytes]] | None = None

    def __enter__(self) -> Self:
        """Open a temporary file in the folder of the bag."""
        with errors_as(BagError, self.file, 'written'):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._replacing = replacing(self.file)
            self.messages = MessageWriter(self._replacing.__enter__())
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
                self.messages.finish()
            if self._metadata_file is not None:
                with replacing(self._metadata_file) as file:
                    file.write(self.messages.metadata(self.file.name).encode())

    def outputs(self) -> list[Path]:
        """Files of the bag to write, and those of any bag in its folder."""
        if self._metadata_file is None:
            return [self.file]
        there = [path for end in _OF_BAGS for path in self.file.parent.glob(end)]
        return [self.file, self._metadata_file, *there]

    def write(self, topic: str, type_name: str, time_ns: int, message: codec.Message) -> None:
        """Write a message; raises BagError where the disk is full or a field cannot hold it."""
        with errors_as(BagError, self.file, 'written'):
            self.messages.write(topic, type_name, time_ns, message)

    def write_image(self, topic: str, image: Image, frame_id: str) -> None:
        """Write a sensor_msgs/Image."""
        message = image_to_message(image, frame_id, make_message)
        self.write(topic, codec.IMAGE_TYPE, image.time_ns, message)

    def write_attitude(self, topic: str, time_ns: int, xyzw: Floats, frame_id: str) -> None:
        """Write a geometry_msgs/QuaternionStamped in the inertial frame ``frame_id``."""
        message = attitude_to_message(time_ns, xyzw, frame_id, make_message)
        self.write(topic, codec.ATTITUDE_TYPE, time_ns, message)

    def write_velocity(
        self, topic: str, time_ns: int, velocity_m_s: Floats, frame_id: str
    ) -> None:
        """Write a geometry_msgs/TwistStamped."""
        message = velocity_to_message(time_ns, velocity_m_s, frame_id, make_message)
        self.write(topic, codec.VELOCITY_TYPE, time_ns, message)

    def write_temperature(
        self, topic: str, time_ns: int, temperature_degc: float, frame_id: str
    ) -> None:
        """Write a sensor_msgs/Temperature."""
        message = temperature_to_message(time_ns, temperature_degc, frame_id, make_message)
        self.write(topic, codec.TEMPERATURE_TYPE, time_ns, message)

    def write_observations(self, topic: str, record: StarObservations, frame_id: str) -> None:
        """Write a starcal/StarObservations."""
        message = observations_to_message(record, frame_id, make_message)
        self.write(topic, codec.OBSERVATIONS_TYPE, record.time_ns, message)


def image_to_message(image: Image, frame_id: str, make: codec.Make) -> codec.Message:
    """Return a sensor_msgs/Image, mono8 or mono16 in the byte order of this machine."""
    pixels = np.ascontiguousarray(image.pixels)
    height, width = pixels.shape
    return make(
        codec.IMAGE_TYPE,
        header=codec.make_header(image.time_ns, frame_id, make),
        height=height,
        width=width,
        encoding='mono8' if pixels.itemsize == 1 else 'mono16',
        is_bigendian=int(sys.byteorder == 'big'),
        step=width * pixels.itemsize,
        data=pixels.reshape(-1).view(np.uint8),
    )


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
