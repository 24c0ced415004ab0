# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of attitude, velocity and temperature: round trips."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sample_records import plain  # type: ignore[import-not-found]

from starcal_ros.bag.typestore import make_message
from starcal_ros.messages.telemetry import (
    attitude_from_message,
    attitude_to_message,
    temperature_from_message,
    temperature_to_message,
    velocity_from_message,
    velocity_to_message,
)


def test_attitude_and_velocity_round_trip() -> None:
    """Components come back in their own places."""
    message = attitude_to_message(5, np.array([0.1, 0.2, 0.3, 0.4]), 'icrf', plain)
    assert (message.quaternion.w, message.header.frame_id) == (0.4, 'icrf')
    time_ns, xyzw = attitude_from_message(message)
    assert time_ns == 5
    np.testing.assert_array_equal(xyzw, [0.1, 0.2, 0.3, 0.4])
    message = velocity_to_message(6, np.array([1.0, -2.0, 3e4]), 'icrf', plain)
    time_ns, velocity = velocity_from_message(message)
    assert time_ns == 6
    np.testing.assert_array_equal(velocity, [1.0, -2.0, 3e4])


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_temperature_round_trip(make: Any) -> None:
    message = temperature_to_message(7, -12.5, 'camera', make)
    assert temperature_from_message(message) == (7, -12.5)
    # A sensor that has failed says inf or NaN: not known.
    message = temperature_to_message(7, np.inf, 'camera', make)
    assert np.isnan(temperature_from_message(message)[1])
