"""Messages of a calibration: round trips, what is refused, and what other readers see."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import cv2
import numpy as np
import pytest
from sample_records import assert_same, calibration, plain, plain_calibration  # type: ignore[import-not-found]

from starcal_ros.bag.typestore import make_message
from starcal_ros.camera import line_of_sight, project
from starcal_ros.messages.calibration import (
    alignment_to_message,
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
)
from starcal_ros.records import GateCheck, Thermal


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_calibration_round_trip(make: Any) -> None:
    """Every number survives its message, bit for bit, and so does what is not known."""
    left_out = dataclasses.replace(calibration(), thermal=Thermal(20.0, note='left out'))
    for record in (calibration(), plain_calibration(), left_out):
        assert_same(record, calibration_from_message(calibration_to_message(record, make)))


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_what_the_gate_did_not_check_is_told(make: Any) -> None:
    gate = (
        *calibration().gate,
        GateCheck('turn', 'max_step_turn_deg', math.nan, 0.5, 'deg', None, 'nothing in force'),
    )
    message = calibration_to_message(dataclasses.replace(calibration(), gate=gate), make)
    assert list(message.gate_kept) == [0, 1, -1]
    # NaN is not equal to itself.
    assert repr(calibration_from_message(message).gate) == repr(gate)


def test_older_calibrations_are_read() -> None:
    """Fields that were added since are as if nothing was known."""
    message = calibration_to_message(calibration(), plain)
    del message.reference_temperature_degc, message.coverage_rows, message.correlation_names
    del message.removal_removed, message.gate_name
    found = calibration_from_message(message)
    assert found.thermal is None and found.maps is None and found.correlation is None
    assert found.removals == () and found.gate == ()


@pytest.mark.parametrize(
    ('field', 'text'),
    [
        ('coverage', 'coverage: 1 numbers, not 2 x 3'),
        ('line_of_sight_sigma_arcsec', 'line_of_sight_sigma_arcsec: 1 numbers, not 4 x 3'),
        ('shape_sigma_arcsec', 'shape_sigma_arcsec: 1 numbers, not 4 x 3'),
        ('correlation', 'correlation: 1 numbers, not 2 x 2'),
        ('removal_wald', 'removal_wald: 1 numbers, not 2'),
        ('removal_within_chance', 'removal_within_chance: 1 numbers, not 2'),
    ],
)
def test_grids_of_another_size_are_refused(field: str, text: str) -> None:
    message = calibration_to_message(calibration(), plain)
    setattr(message, field, np.zeros(1))
    with pytest.raises(ValueError, match=text):
        calibration_from_message(message)


@pytest.mark.parametrize(
    ('field', 'text'),
    [
        ('focal_per_degc_sigma', 'focal_per_degc_sigma: 1 numbers, not 2'),
        ('alignment_rate_rad_per_degc', 'alignment_rate_rad_per_degc: 1 numbers, not 3 or none'),
        ('alignment_rate_rad_per_degc_sigma', '1 numbers, not 3'),
    ],
)
def test_bad_terms_of_temperature_are_refused(field: str, text: str) -> None:
    message = calibration_to_message(calibration(), plain)
    setattr(message, field, np.zeros(1))
    with pytest.raises(ValueError, match=text):
        calibration_from_message(message)


def test_empty_calibration_is_refused() -> None:
    """The calibration of an answer without solution is not taken for a camera."""
    message = calibration_to_message(calibration(), plain)
    message.parameter_names = []
    with pytest.raises(ValueError, match='none are not the thirteen'):
        calibration_from_message(message)


def test_camera_info_projects_like_the_calibration() -> None:
    """What a ROS reader makes of camera_info is the camera, to the cost the calibration names."""
    record = calibration()
    message = camera_info_to_message(record, make_message)
    assert message.distortion_model == 'plumb_bob'
    assert (message.width, message.height) == (1296, 1024)
    assert message.k[1] == 0.0
    np.testing.assert_array_equal(message.p.reshape(3, 4)[:, :3], message.k.reshape(3, 3))
    camera = record.geometry.camera
    pixels = np.array([[0.0, 0.0], [647.5, 511.5], [1295.0, 1023.0], [1295.0, 0.0]])
    directions = line_of_sight(camera, pixels)
    seen, _ = cv2.projectPoints(
        directions, np.zeros(3), np.zeros(3), message.k.reshape(3, 3), message.d
    )
    # A skew of -0.74 over a field of +-0.14 is a tenth of a pixel at the corners.
    assert np.abs(seen[:, 0] - project(camera, directions)).max() < 0.15


def test_alignment_message() -> None:
    """The child is the camera, the rotation takes its coordinates to the star tracker's."""
    message = alignment_to_message(calibration(), plain)
    assert (message.header.frame_id, message.child_frame_id) == ('st', 'cam')
    assert message.transform.rotation.y == -0.7
