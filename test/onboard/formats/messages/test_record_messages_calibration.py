# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of a calibration and a status: round trips, what is refused, what readers see."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sample_records import (  # type: ignore[import-not-found]
    assert_same,
    calibration,
    plain,
    plain_calibration,
    status,
    without_field,
)

from starcal_ros.camera import line_of_sight, project
from starcal_ros.estimation import levenberg_marquardt
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.formats.bag.typestore import make_message, typestore
from starcal_ros.formats.messages.message_codec import (
    CALIBRATION_TYPE,
    NOT_KNOWN,
    record_from_message,
)
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
    status_to_message,
)
from starcal_ros.records import EnsembleStatus, GateCheck, TemperatureTerms

ROOT = Path(__file__).resolve().parents[4]


def test_calibration_round_trip() -> None:
    """Every number that is sent survives, bit for bit, and so does what is not known."""
    left_out = dataclasses.replace(
        calibration(), temperature=TemperatureTerms(20.0, note='left out')
    )
    records = (calibration(), without_field(), plain_calibration())
    for record in (*records, left_out):
        sent = dataclasses.replace(record, model_checks=None)
        assert_same(sent, calibration_from_message(calibration_to_message(record, make_message)))


def test_a_check_that_was_not_made_is_neither_passed_nor_failed() -> None:
    gate = (
        *calibration().gate,
        GateCheck('turn', 'max_step_rotation_deg', math.nan, 0.5, 'deg', None, 'none active'),
    )
    message = calibration_to_message(dataclasses.replace(calibration(), gate=gate), make_message)
    assert [check.passed for check in message.gate] == [0, 1, 2]
    # NaN is not equal to itself.
    assert repr(calibration_from_message(message).gate) == repr(gate)
    message.gate[0].passed = 3
    with pytest.raises(ValueError, match=r'gate\[0\].passed: 3 is not true or false'):
        calibration_from_message(message)


def test_constants_of_the_definitions_are_those_of_the_code() -> None:
    """Methods and terminations by the names of the options and of the solver."""
    store = typestore()
    fields = {name: value for name, _, value in store.fielddefs[CALIBRATION_TYPE][0]}
    (method,) = (f for f in dataclasses.fields(CalibrationOptions) if f.name == 'method')
    assert {fields[name] for name in ('PER_IMAGE', 'SINGLE', 'HIERARCHICAL')} == set(
        method.metadata['item'].choices
    )
    source = Path(levenberg_marquardt.__file__).read_text()
    for name in ('CONVERGED', 'NO_DESCENT', 'ITERATION_LIMIT'):
        assert f"'{fields[name]}'" in source
    checks = {name: value for name, _, value in store.fielddefs['starcal/msg/GateCheck'][0]}
    assert checks == {'FAILED': 0, 'PASSED': 1, 'NOT_CHECKED': NOT_KNOWN}
    cameras = {name: value for name, _, value in store.fielddefs['starcal/msg/CameraModel'][0]}
    assert cameras['PLUMB_BOB'] == calibration().geometry.camera.model


def test_every_field_of_a_record_has_its_field_in_the_message() -> None:
    """A message is built from all fields of its definition: rosbags refuses one too few."""
    definitions = {path.stem for path in (ROOT / 'msg').glob('*.msg')}
    made = calibration_to_message(calibration(), make_message)
    used = {made.__msgtype__.rpartition('/')[2]}

    def collect(message: Any) -> None:
        used.add(message.__msgtype__.rpartition('/')[2])
        for value in vars(message).values():
            for one in value if isinstance(value, list) else [value]:
                if getattr(one, '__msgtype__', '').startswith('starcal/'):
                    collect(one)

    collect(made)
    # The last is of a node of the ground.
    assert used == definitions - {'EnsembleStatus', 'StarObservations', 'SetupDiagnosis'}
    assert len(definitions) <= 15


def test_a_rate_has_three_numbers_or_none() -> None:
    message = calibration_to_message(calibration(), plain)
    message.temperature[0].alignment_rate_rad_per_degc = np.zeros(1)
    message.temperature[0].alignment_rate_rad_per_degc_sigma = np.zeros(1)
    with pytest.raises(ValueError, match='alignment_rate_rad_per_degc: 1 numbers, not 3 or none'):
        calibration_from_message(message)


def test_a_covariance_that_does_not_fit_the_camera_is_refused() -> None:
    message = calibration_to_message(calibration(), plain)
    message.covariance = np.zeros(144)
    with pytest.raises(ValueError, match='covariance: 12 x 12 numbers, not 13 x 13'):
        calibration_from_message(message)


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (lambda m: setattr(m, 'parameter_names', []), 'parameter_names: none, not fx, skew'),
        (
            lambda m: setattr(m.camera, 'parameter_names', ['fx']),
            'camera.parameter_names: fx',
        ),
        (lambda m: setattr(m.camera, 'parameters', np.zeros(0)), 'parameters: '),
        (lambda m: setattr(m.camera, 'width', 0), 'image size: 0 x 1024'),
        (lambda m: setattr(m.alignment.rotation, 'w', 3.0), 'is not a unit quaternion'),
    ],
)
def test_a_message_without_a_camera_is_refused(change: Any, text: str) -> None:
    """The empty calibration of an answer without solution is one of these."""
    message = calibration_to_message(calibration(), plain)
    change(message)
    with pytest.raises(ValueError, match=text):
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


def test_a_status_comes_back() -> None:
    message = status_to_message(status(), 'cam', make_message)
    assert message.header.frame_id == 'cam'
    assert_same(status(), record_from_message(EnsembleStatus, message))
