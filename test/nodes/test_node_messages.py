# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Conversions of every record to a generated message, its serialised bytes, and back."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from rclpy.serialization import deserialize_message, serialize_message
from sample_records import assert_same, calibration, observations, status  # type: ignore[import-not-found]

from starcal_ground.bag_writer import image_to_message
from starcal_ros.formats.bag import typestore as bag_types
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
    observations_from_message,
    observations_to_message,
    status_to_message,
)
from starcal_ros.formats.messages.sensor_messages import image_from_message
from starcal_ros.records import Image
from starcal_ros.ros.node import make_message, message_class

pytestmark = pytest.mark.nodes


def through_wire(message: Any) -> Any:
    """Return the message after serialisation and back."""
    return deserialize_message(serialize_message(message), type(message))


def test_records_survive_the_wire() -> None:
    record = observations()
    message = through_wire(observations_to_message(record, 'cam', make_message))
    assert_same(record, observations_from_message(message))
    # The checks of the model stay in calibration.json.
    result = dataclasses.replace(calibration(), model_checks=None)
    message = through_wire(calibration_to_message(result, make_message))
    assert_same(result, calibration_from_message(message))
    message = status_to_message(status(), 'cam', make_message)
    assert through_wire(message) == message


def test_both_kinds_of_message_are_the_same_on_the_wire() -> None:
    """Nodes and bag writer serialise equal messages, up to padding bytes."""
    for build in (
        lambda make: observations_to_message(observations(), 'cam', make),
        lambda make: calibration_to_message(calibration(), make),
        lambda make: camera_info_to_message(calibration(), make),
        lambda make: alignment_to_message(calibration(), make),
        lambda make: image_to_message(Image(5, np.ones((4, 6), np.uint16)), 'c', make),
    ):
        live, recorded = build(make_message), build(bag_types.make_message)
        data = bag_types.typestore().serialize_cdr(recorded, recorded.__msgtype__)
        assert len(serialize_message(live)) == len(data)
        assert deserialize_message(bytes(data), type(live)) == live


def test_large_images_are_quick() -> None:
    """Construction and reading of 26 MB takes about as long as a copy."""
    image = Image(0, np.ones((3600, 3600), np.uint16))
    start_s = time.perf_counter()
    back = image_from_message(image_to_message(image, '', make_message))
    assert time.perf_counter() - start_s < 1.0  # 20 ms alone; an element-wise copy takes 1.6 s
    np.testing.assert_array_equal(back.pixels, image.pixels)


def test_unknown_types_are_import_errors() -> None:
    for name in ('no_such_msgs/msg/Thing', 'sensor_msgs/msg/NoSuchThing'):
        with pytest.raises(ImportError):
            message_class(name)
