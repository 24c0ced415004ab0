# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of observations, calibration and status: round trips, and what is refused."""

import dataclasses
import functools
import math
from pathlib import Path
import re
from typing import Any

import cv2
import numpy as np
import pytest
from sample_records import (  # type: ignore[import-not-found]
    assert_same,
    calibration,
    NEEDED,
    observations,
    plain,
    plain_calibration,
    status,
    TIME_NS,
    with_needed_fields,
    without_field,
    zeroed,
)

from starcal_ros.camera import line_of_sight, project
from starcal_ros.estimation import levenberg_marquardt
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.formats.bag.typestore import described, make_message, typestore
from starcal_ros.formats.messages.message_codec import (
    CALIBRATION_TYPE,
    NOT_KNOWN,
    OBSERVATIONS_TYPE,
    record_from_message,
)
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
    checked_observations,
    observations_from_message,
    observations_to_message,
    status_to_message,
)
from starcal_ros.records import EnsembleStatus, GateCheck, refused_image, TemperatureTerms


def test_calibration_round_trip() -> None:
    """Every number that is sent survives, bit for bit, and so does what is not known."""
    terms = TemperatureTerms(20.0, note='left out')
    left_out = dataclasses.replace(calibration(), temperature=terms)
    for record in (calibration(), without_field(), plain_calibration(), left_out):
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


RATES = ('alignment_rate_rad_per_degc', 'alignment_rate_rad_per_degc_sigma')


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        (lambda m: setattr(m, 'parameter_names', []), 'parameter_names: none, not fx, skew'),
        (lambda m: setattr(m.camera, 'parameter_names', ['fx']), 'camera.parameter_names: fx'),
        (lambda m: setattr(m, 'covariance', np.zeros(144)), '12 x 12 numbers, not 13 x 13'),
        (
            lambda m: vars(m.temperature[0]).update(dict.fromkeys(RATES, np.zeros(1))),
            'alignment_rate_rad_per_degc: 1 numbers, not 3 or none',
        ),
        (lambda m: setattr(m.camera, 'parameters', np.zeros(0)), 'parameters: '),
        (lambda m: setattr(m.camera, 'width', 0), 'image size: 0 x 1024'),
        (lambda m: setattr(m.alignment.rotation, 'w', 3.0), 'is not a unit quaternion'),
    ],
)
def test_a_message_that_is_no_calibration_is_refused(change: Any, text: str) -> None:
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


def test_observations_and_a_status_come_back() -> None:
    """Every number of a record survives its message, bit for bit."""
    refused = refused_image(TIME_NS, 1, 2, 'no_stars', 'three')
    for record in (observations(), refused):
        message = observations_to_message(record, 'cam', make_message)
        assert_same(record, observations_from_message(message))
    message = status_to_message(status(), 'cam', make_message)
    assert message.header.frame_id == 'cam'
    assert_same(status(), record_from_message(EnsembleStatus, message))


def first(column: str, value: float) -> Any:
    """A column of the observations with another first number."""
    changed = getattr(observations_to_message(observations(), 'cam', plain), column).copy()
    changed[0] = value
    return changed


@pytest.mark.parametrize(
    ('place', 'value', 'text'),
    [
        ('header.stamp.sec', -1, 'header.stamp: -876543211 is not within 0 to'),
        ('header.stamp.nanosec', 2**32 - 1, ''),  # a carry that the stamp can hold
        ('attitude.w', 0.0, 'attitude: length 0.714143 is not 1'),
        ('temperature_degc', 1e300, r'temperature_degc: 1e\+300 is not within -273.15 to 1000'),
        ('velocity_sigma_m_s', -2.0, 'velocity_sigma_m_s: -2.0 is not at least 0'),
        ('velocity_sigma_m_s', np.inf, 'velocity_sigma_m_s: inf is not a finite number'),
        ('star_tracker_rate_rad_s', np.r_[0, 0, np.inf], r'star_tracker_rate_rad_s\[2\]: inf'),
        ('attitude_gap_s', -1.0, 'attitude_gap_s: -1.0 is not at least 0'),
        ('background_dn', np.inf, 'background_dn: inf is not a finite number'),
        ('width', 2**32 - 1, 'width: 4294967295 is not within 0 to 65536'),
        ('refusal', 'x' * 10**6, "refusal: 'x{50,60}[.]{3} is not one of bad_encoding, "),
        ('catalog_digest', 'x' * 10**6, "catalog_digest: 'x.* is not a text of at most 100 char"),
        # Columns of the stars, and of the refused ones.
        ('measured_px', first('measured_px', 1e300), r'measured_px: \(1e\+300, '),
        ('measured_px', first('measured_px', -2.0), r'measured_px: \(-2, '),
        ('covariance_px2', np.zeros(15), 'covariance_px2: not positive definite'),
        ('covariance_px2', first('covariance_px2', 1e300), 'covariance_px2: '),
        ('covariance_px2', first('covariance_px2', 1e-300), 'covariance_px2: '),
        ('measured_px', np.full(10, np.nan), r'measured_px\[0\]\[0\]: nan is not a finite number'),
        (
            'direction_icrf',
            first('direction_icrf', 0.0),
            r'direction_icrf\[0\]: length 0.785404 is not 1',
        ),
        ('catalog_id', np.full(len(observations()), 7), 'catalog_id: 7 is given twice'),
        ('snr', first('snr', np.inf), r'snr\[0\]: inf is not a finite number'),
        ('refused_star_px', np.full(8, np.inf), r'refused_star_px\[0\]\[0\]: inf is not a finite'),
        ('refused_star_counts', np.zeros(1, np.uint32), '.*: 2 reasons but 1 counts'),
        ('refused_star_reason', np.full(4, 2), 'refused_star_reason: 2 is not one of 2 reasons'),
    ],
)
def test_a_value_that_no_image_has_is_refused(place: str, value: Any, text: str) -> None:
    """By the name of the field; the refusal has no stars."""
    message = observations_to_message(observations(), 'cam', plain)
    *holders, field = place.split('.')
    setattr(functools.reduce(getattr, holders, message), field, value)
    record = checked_observations(message)
    assert record.refusal == ('bad_observations' if text else '')
    assert (len(record) == 0) == bool(text)
    assert re.match(text, record.detail) and len(record.detail) <= 500
    if text:
        with pytest.raises(ValueError, match=text):
            observations_from_message(message)
    # The refusal itself can be published and saved.
    back = observations_from_message(observations_to_message(record, 'cam', make_message))
    assert_same(record, back)


@pytest.mark.parametrize('refusal', ['', 'too_few_stars'])
def test_an_image_without_stars_states_why(refusal: str) -> None:
    empty = observations().select(np.zeros(len(observations()), np.bool_))
    record = dataclasses.replace(empty, refusal=refusal)
    found = checked_observations(observations_to_message(record, 'cam', plain))
    assert found.refusal == (refusal or 'bad_observations')
    assert bool(refusal) or found.detail == 'refusal: empty, but the image has no stars'


def test_a_long_detail_is_cut() -> None:
    message = observations_to_message(observations(), 'cam', plain)
    message.detail = 'x' * 10**6
    assert len(checked_observations(message).detail) == 500


def test_a_message_with_everything_but_the_stars_at_zero_says_nothing_else() -> None:
    """A velocity was exact, a camera did not turn, and the zenith refused the image."""
    sent = observations()
    message = observations_to_message(sent, 'cam', plain)
    others = [name for name in vars(message) if name not in NEEDED]
    assert {'zenith_icrf', 'star_tracker_rate_sigma_rad_s', 'first_from_star_tracker'} <= {*others}
    definition = described(OBSERVATIONS_TYPE)[0]
    for name in others:
        setattr(message, name, zeroed(getattr(message, name), f'[] {name}\n' in definition))
    record = checked_observations(message)
    assert not record.refusal, record.detail
    # Zero degrees Celsius is a temperature; if all images have it, it does not change.
    assert_same(record, with_needed_fields(sent, attitude_gap_s=0.0, temperature_degc=0.0))


def test_an_exact_velocity_is_not_sent_as_zero() -> None:
    for sigma_m_s, sent in ((0.0, -1.0), (10.0, 10.0), (np.nan, np.nan)):
        record = dataclasses.replace(observations(), velocity_sigma_m_s=sigma_m_s)
        message = observations_to_message(record, 'cam', plain)
        np.testing.assert_equal(message.velocity_sigma_m_s, sent)
        assert_same(record, observations_from_message(message))


@pytest.mark.parametrize(
    ('rate', 'sigma', 'is_known'),
    [(0.0, 0.0, False), (0.0, np.nan, False), (0.0, 1e-5, True), (1e-3, 0.0, True)],
)
def test_a_camera_at_rest_has_a_rate_with_a_sigma(rate, sigma, is_known) -> None:
    message = observations_to_message(observations(), 'cam', plain)
    message.star_tracker_rate_rad_s = np.full(3, rate)
    message.star_tracker_rate_sigma_rad_s = np.full(3, sigma)
    record = observations_from_message(message)
    assert np.isfinite(record.star_tracker_rate_rad_s).all() == is_known
    assert np.isfinite(record.star_tracker_rate_sigma_rad_s).all() == (sigma > 0)
