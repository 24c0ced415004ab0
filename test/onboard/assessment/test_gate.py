# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The gate: every limit trips by itself, with its own reason, and nothing that is NaN passes."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from sample_records import calibration, model_checks  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from starcal_ros.assessment.gate import GateOptions, judge, reasons_of
from starcal_ros.assessment.lookup import movement
from starcal_ros.camera import CameraModel
from starcal_ros.camera.projection import convert
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import camera_at
from starcal_ros.options import names_of
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    DetectorMaps,
    DetectorStep,
    GateCheck,
    HeldTerm,
    ResidualBin,
    StarTrackerAlignment,
    TemperatureTerms,
)

CAMERA = CameraModel(
    640, 512, np.array([1800, 0.2, 1801, 320, 255, -0.045, 0.08, 0.0, 4e-4, -3e-4])
)
MOUNTING = Rotation.from_euler('zyx', [-91.0, -28.0, 3.0], degrees=True)
PRIOR = CameraGeometry(CAMERA, MOUNTING.as_quat())
ESTIMATED = ('fx', 'skew', 'fy', 'k1', 'k2', 'k3', 'p1', 'p2')
SIGHT_ARCSEC = 2.0
ASSUMED = CalibrationOptions(star_tracker_sigma_arcsec=(10.0, 10.0, 10.0))
# An alignment known to 1.4 arcsec each axis, and a camera without uncertainty.
SIGMA = np.r_[np.zeros(10), np.full(3, 1e-6)]
GOOD: Calibration = dataclasses.replace(
    calibration(),
    geometry=PRIOR,
    covariance=np.diag(SIGMA**2),
    estimated=ESTIMATED,
    residual_rms_px=0.1,
    images_used=20,
    misfit_images_ns=(5,),
    stars_used=990,
    stars_rejected=10,
    star_tracker_sigma_arcsec=ASSUMED.star_tracker_sigma_arcsec,
    singular_values=(1.5, 0.02),
    zero_skew_cost_px=0.1,
    termination='converged',
    maps=DetectorMaps(
        np.ones((8, 10), np.int64), np.full((16, 20), SIGHT_ARCSEC), np.zeros((16, 20))
    ),
    model_checks=model_checks(),
    field=None,
)


def judged(
    found: Calibration, options: GateOptions, active: Calibration | None = None
) -> tuple[GateCheck, ...]:
    return judge(found, PRIOR, active, options, ASSUMED)


def reasons(
    found: Calibration, options: GateOptions, active: Calibration | None = GOOD
) -> tuple[str, ...]:
    return reasons_of(judged(found, options, active))


def checks(
    found: Calibration, options: GateOptions, active: Calibration | None = GOOD
) -> dict[str, GateCheck]:
    """By the parameter that limits them, those without one by their name."""
    return {check.option or check.name: check for check in judged(found, options, active)}


def limits_in(found: tuple[str, ...]) -> list[str]:
    """The first word in brackets of each reason: the parameter of the limit."""
    return [re.findall(r'\((\w+)\)', reason)[0] for reason in found]


def turned(degrees: float, axis: str = 'x', **parameters: float) -> CameraGeometry:
    rotation = MOUNTING * Rotation.from_euler(axis, degrees, degrees=True)
    return CameraGeometry(CAMERA.replace(**parameters), rotation.as_quat())


def with_maps(**changes: np.ndarray) -> dict[str, Any]:
    assert GOOD.maps is not None
    return {'maps': dataclasses.replace(GOOD.maps, **changes)}


HALF_COVERED = np.repeat([7, 0], 40).reshape(8, 10)


def with_model(**changes: Any) -> dict[str, Any]:
    assert GOOD.model_checks is not None
    return {'model_checks': dataclasses.replace(GOOD.model_checks, **changes)}


def drifting(drift_arcsec: float, p_value: float) -> StarTrackerAlignment:
    return dataclasses.replace(
        GOOD.star_trackers[0], frame='head_2', drift_arcsec=drift_arcsec, drift_p_value=p_value
    )


def less_certain(by: str, low: float, high: float) -> dict[str, Any]:
    """A part of the data that scatters by 1.5 of its predicted sigma."""
    return with_model(predictions=(ResidualBin(by, low, high, 10000, 1.5, 0.005),))


@pytest.mark.parametrize(
    ('changes', 'limit', 'at_limit', 'beyond', 'words'),
    [
        (
            {'stars_used': 90, 'stars_rejected': 10},
            *('max_rejected_fraction', 0.1, 0.099, 'stars .* smeared'),
        ),
        (with_maps(stars=HALF_COVERED), 'min_coverage', 0.5, 0.51, 'under .* empty cells'),
        (
            {'misfit_images_ns': (1, 2, 3, 4, 5, 6)},
            *('max_rejected_fraction', 0.3, 0.29, 'images .* stamps'),
        ),
        (
            *({}, 'requirements', ('line_of_sight=2arcsec',), ('line_of_sight=1.9arcsec',)),
            'largest 1-sigma of line_of_sight .*; missed by 0.1 arcsec; state the velocity',
        ),
        (
            with_model(step=DetectorStep('u', 320.4, 'v', -0.15, 1e-9)),
            *('max_detector_step_px', 0.15, 0.14),
            'in v at u = 320 is 0.15 px, .*; p-value < 0.000001; .* read-out',
        ),
        (
            with_model(image_variation_px=0.25),
            *('max_image_variation_px', 0.25, 0.2, 'in a corner .* one focus'),
        ),
        (
            {'star_trackers': (GOOD.star_trackers[0], drifting(80.0, 1e-6))},
            *('max_star_tracker_drift_arcsec', 80.0, 60.0),
            'of head_2 .*; p-value 0.000001; leave it out',
        ),
        (
            less_certain('star', 5.0, 9.0),
            *('max_cross_validated_residual', 1.5, 1.25, 'at star 5 to 9 .* the PSF'),
        ),
        (  # images are numbered from one, as on the report
            less_certain('image', 7.0, 9.0),
            *('max_cross_validated_residual', 1.5, 1.25, 'at image 8 to 10 .* the PSF'),
        ),
    ],
)
def test_each_limit_trips_alone(changes, limit, at_limit, beyond, words) -> None:
    """The reason names what failed and what to do; its form is that of the next test."""
    found = dataclasses.replace(GOOD, **changes)
    assert reasons(found, GateOptions(**{limit: at_limit})) == ()
    (reason,) = reasons(found, GateOptions(**{limit: beyond}))
    assert limits_in((reason,)) == [limit] and re.search(words, reason)
    assert len(reason) <= 200


VELOCITY = HeldTerm('velocity_x_m_s', 0.0, -6e4, 8000.0)


@pytest.mark.parametrize(
    ('term', 'changes', 'sigmas', 'note'),
    [
        (
            HeldTerm('cx', 320.0, 323.0, 1.0),
            *({}, 3.0, '323 by the stars, 320 assumed; estimate it, or widen its prior'),
        ),
        (VELOCITY, {}, 7.5, 'the stars add -60000 to it; correct it so'),
        (VELOCITY, {'statements': ()}, 7.5, 'none was received, that of the Earth was assumed'),
        (
            HeldTerm('clock_offset_min', 0.0, -42.5, 5.0),
            *({}, 8.5, 'the stars add -42.5 to it; check site and UTC'),
        ),
        (
            HeldTerm('mounting of head_2 x_deg', 0.0, 20.0, 0.125),
            *({}, 160.0, 'the stars add 20 to it; check more_alignments'),
        ),
    ],
)
def test_a_prior_that_the_stars_contradict_is_named(term, changes, sigmas, note) -> None:
    found = dataclasses.replace(GOOD, **with_model(held=(term,), **changes))
    assert reasons(found, GateOptions(max_held_term_sigma=sigmas)) == ()
    (reason,) = reasons(found, GateOptions(max_held_term_sigma=sigmas - 0.1))
    assert reason.startswith(
        f'distance of {term.name} from its assumed value is {sigmas:g} sigma, over the limit of'
        f' {sigmas - 0.1:g} sigma (max_held_term_sigma); {note}'
    )
    assert len(reason) <= 200


LONGER = turned(0.0, fx=1818.0, fy=1819.01)
TURNED = turned(0.2)
TURNED_FAR = turned(6.0)
# Beyond multiples of the limits: the angle of 3 % of the longer side, degrees; and the note.
OF_THE_PRIOR = {
    'max_change_px': (0.0, 5.0, 'limit: 5 times max_change_px'),
    'max_rotation_deg': (
        *(np.degrees(0.03 * 640 / 1800), 13.0),
        'limit: 13 times max_rotation_deg and 0.61 deg',
    ),
}
CHANGES = [
    ('max_change_px', LONGER, None, 3.916, 'prior camera or lens_model does not match this lens'),
    ('max_rotation_deg', TURNED_FAR, None, 6.0, 'check prior_alignment and the mounting'),
    ('max_change_px', LONGER, GOOD, 3.916, 'find out if the camera has changed'),
    ('max_rotation_deg', TURNED, GOOD, 0.2, 'find out if the mounting has changed'),
]


@pytest.mark.parametrize(('limit', 'geometry', 'active', 'expected', 'remedy'), CHANGES)
def test_each_limit_of_a_change_trips_alone(limit, geometry, active, expected, remedy) -> None:
    """The value found is the expected one, and a limit on either side of it decides."""
    found = dataclasses.replace(GOOD, geometry=geometry)
    check = checks(found, GateOptions(), active)[limit]
    # The curvature of the field takes 4 % off the first; the others agree to 1e-3.
    assert check.found == pytest.approx(expected, rel=0.05)
    # A change from the prior may be larger, as far as it is documented.
    more, factor, note = OF_THE_PRIOR[limit] if active is None else (0.0, 1.0, '')
    value = (check.found - more) / factor
    limits: list[dict[str, Any]] = [{limit: value * (1 + 1e-12)}, {limit: 0.99 * value}]
    at_limit, beyond = (GateOptions(**row) for row in limits)
    assert reasons(found, at_limit, active) == ()
    assert checks(found, at_limit, active)[limit].note == note
    (reason,) = reasons(found, beyond, active)
    assert reason.startswith(check.name) and limits_in((reason,)) == [limit]
    assert reason.endswith(remedy) and len(reason) <= 200
    assert ('active calibration' in reason) == (active is not None)


@pytest.mark.parametrize(('width', 'limit_px'), [(640, 50.0), (1000, 64.0), (2592, 165.9)])
def test_a_large_detector_may_change_more_from_the_prior(width: int, limit_px: float) -> None:
    """The prior of the lens, a tenth of the half diagonal in a corner, does not contradict it."""
    camera = dataclasses.replace(CAMERA, width=width, height=width * 512 // 640)
    prior = CameraGeometry(camera, PRIOR.star_tracker_from_camera_xyzw)
    found = dataclasses.replace(GOOD, geometry=prior)
    rows = judge(found, prior, None, GateOptions(max_rotation_deg=180.0), ASSUMED)
    (row,) = (row for row in rows if row.option in PAIR)
    assert row.option == 'max_change_px' and row.limit == pytest.approx(limit_px, abs=0.1)


def test_the_remaining_images_must_be_enough() -> None:
    """The limit on images holds for those that fit, not for those collected; both in full."""
    options = GateOptions(max_rejected_fraction=1.0)
    found = dataclasses.replace(
        GOOD, misfit_images_ns=tuple(range(18)), stars_used=50, stars_rejected=0
    )
    assert reasons(found, options) == (
        'number of images that fit is 2, under the limit of 3 (min_images); take more images',
    )
    many = checks(dataclasses.replace(GOOD, images_used=123457), GateOptions())['min_images']
    assert (many.found_text, many.limit_text) == ('123456', '3')


def test_an_active_calibration_of_another_lens_model_is_compared_too() -> None:
    rational, _ = convert(CAMERA, 'rational_polynomial')
    geometry = CameraGeometry(rational, PRIOR.star_tracker_from_camera_xyzw)
    active = dataclasses.replace(GOOD, geometry=geometry, covariance=np.zeros((16, 16)))
    found = checks(dataclasses.replace(GOOD, geometry=LONGER), GateOptions(), active)
    assert found['max_change_px'].found == pytest.approx(3.916, rel=0.05)


def test_a_change_is_that_at_one_temperature() -> None:
    """A focal length that grows with temperature has not changed between two references."""
    terms = TemperatureTerms(20.0, (1e-3,), (1e-5,), (1e-5, 2e-5, 0.0), (1e-6,) * 3)
    active = dataclasses.replace(GOOD, temperature=terms)
    at_50 = dataclasses.replace(terms, reference_degc=50.0)
    warm = dataclasses.replace(GOOD, geometry=camera_at(active, 50.0), temperature=at_50)
    # The two limits are one row: the one with the larger share of its limit.
    (change,) = (row for row in judged(warm, GateOptions(), active) if row.option in PAIR)
    assert change.found < 1e-6
    # Without terms it has: the limits see it.
    assert {*limits_in(reasons(warm, GateOptions(), GOOD))} & {*PAIR}


PAIR = ('max_change_px', 'max_rotation_deg')


def test_every_limit_has_its_check() -> None:
    """With the limit as the option has it."""
    tracker = dataclasses.replace(GOOD.star_trackers[0], drift_arcsec=1.0, drift_p_value=0.5)
    found = checks(dataclasses.replace(GOOD, star_trackers=(tracker,)), GateOptions())
    assert not any(check.passed is False for check in found.values())
    assert len([name for name in found if not name.endswith(' as stated')]) <= 12
    limited = {name for name in found if found[name].option}
    assert len(limited & {*PAIR}) == 1  # the one with the larger share of its limit is a row
    assert limited | {*PAIR} == names_of(GateOptions) | {'min_images'}
    for name in names_of(GateOptions) & found.keys() - {'requirements'}:
        assert found[name].limit == getattr(GateOptions(), name)
    assert 'p-value 0.7' in found['max_detector_step_px'].note
    of_a_message = checks(dataclasses.replace(GOOD, model_checks=None), GateOptions())
    assert not {'max_detector_step_px', 'max_image_variation_px'} & {*of_a_message}
    with pytest.raises(ValueError, match='needs its detector maps'):
        judged(dataclasses.replace(GOOD, maps=None), GateOptions())


@pytest.mark.parametrize('lens', [20.0, 100.0])
def test_what_a_prior_may_be_off_by_is_no_reason_to_refuse(lens: float) -> None:
    """1.5 degrees and 5 degrees in roll (`prior_alignment`), and 3 % in the principal point."""
    f = 320 / np.tan(np.radians(lens / 2))
    centre = dataclasses.replace(CAMERA, parameters=np.r_[f, 0, f, 320, 255, np.zeros(5)])
    prior = CameraGeometry(centre, MOUNTING.as_quat())
    off = MOUNTING * Rotation.from_euler('xz', [1.5, 5.0], degrees=True)
    camera = centre.replace(cy=255 + 0.03 * 640)
    found = dataclasses.replace(GOOD, geometry=CameraGeometry(camera, off.as_quat()))
    assert reasons_of(judge(found, prior, None, GateOptions(), ASSUMED)) == ()


def parts(normalised: float, sigma: float) -> tuple[ResidualBin, ...]:
    return (
        ResidualBin('cell', 0.0, 300.0, 2500, 1.01, 0.01),
        ResidualBin('cell', 300.0, 700.0, 2500, normalised, sigma),
    )


@pytest.mark.parametrize(
    'changes',
    [
        with_model(step=DetectorStep('v', 100.0, 'u', 0.5, 1e-4)),
        with_model(predictions=parts(1.3, 0.1)),  # of few stars
        with_model(predictions=parts(1.15, 0.01)),
        {'star_trackers': (drifting(80.0, 1e-3),)},
        {'star_trackers': (drifting(20.0, 1e-6),)},
    ],
)
def test_what_noise_explains_passes_beyond_its_limit(changes: dict[str, Any]) -> None:
    assert reasons(dataclasses.replace(GOOD, **changes), GateOptions()) == ()


def test_a_search_that_did_not_converge_is_refused() -> None:
    for termination in ('no_descent', 'iteration_limit'):
        found = dataclasses.replace(GOOD, termination=termination)
        (reason,) = reasons(found, GateOptions())
        assert reason == (
            f'the solver did not converge ({termination}); check lens_model and the prior camera,'
            ' and that all images are of one camera'
        )


def test_every_reason_is_given_and_the_cause_before_the_statistics() -> None:
    """A lens that changes from image to image spoils residuals, predictions and sigmas as well."""
    found = dataclasses.replace(
        GOOD,
        residual_rms_px=9.0,
        stars_rejected=5000,
        covariance=np.diag(np.r_[100.0, SIGMA[1:]] ** 2),
        termination='no_descent',
        geometry=turned(5.0, k1=6.0),
        **with_maps(stars=np.zeros((8, 10), np.int64)),
        **with_model(
            image_variation_px=0.38,
            held=(HeldTerm('velocity x', 0.0, 9e4, 1e3),),
            predictions=tuple(ResidualBin('star', k, k + 1.0, 9999, 1.5, 0.01) for k in range(18)),
        ),
    )
    given = reasons(found, GateOptions())
    assert limits_in(given) == [
        'no_descent', 'max_image_variation_px', 'max_held_term_sigma', 'max_rejected_fraction',
        'min_coverage', 'requirements', 'max_rotation_deg', 'max_cross_validated_residual',
    ]  # fmt: skip
    # One part of the data and what to do, not a list of eighteen.
    assert len(given[-1]) < 200


def with_covariance(row: int, column: int, value: float) -> dict[str, Any]:
    covariance = GOOD.covariance.copy()
    covariance[row, column] = value
    return {'covariance': covariance}


ONE_NAN = np.r_[np.nan, np.full(319, SIGHT_ARCSEC)].reshape(16, 20)
NOT_FINITE = 'a parameter, its covariance or the residual is not a finite number'


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        (with_covariance(5, 5, np.nan), NOT_FINITE),
        (with_covariance(5, 5, np.inf), NOT_FINITE),
        (with_covariance(5, 11, np.nan), NOT_FINITE),
        ({'residual_rms_px': np.nan}, NOT_FINITE),
        ({'geometry': CameraGeometry(CAMERA, np.array([np.nan, 0.0, 0.0, 1.0]))}, NOT_FINITE),
        (with_covariance(3, 3, -1e-9), 'a variance is negative'),
        (
            with_maps(line_of_sight_sigma_arcsec=ONE_NAN),
            'largest 1-sigma of line_of_sight is not a finite number',
        ),
    ],
)
def test_a_number_that_no_calibration_has_is_refused(changes: dict[str, Any], reason: str) -> None:
    (refused,) = reasons(dataclasses.replace(GOOD, **changes), GateOptions())
    assert refused.startswith(reason)


@pytest.mark.parametrize(
    ('after', 'rotation_deg', 'most_px'),
    [
        *(
            (turned(degrees, axis), pytest.approx(degrees, abs=1e-7), pytest.approx(0.0, abs=1e-6))
            for axis in 'xyz'
            for degrees in (0.01, 1.0, 30.0, 170.0)
        ),
        # 1 % at the corner, 1800 px * 0.01 * 0.227 = 4.1 px; the field curves a little of it away.
        (LONGER, pytest.approx(0.0, abs=0.01), pytest.approx(4.1, abs=0.4)),
        # 30 px of 1800 are 0.955 degrees: mostly a rotation.
        (
            turned(0.0, cx=350.0),
            pytest.approx(0.955, abs=0.03),
            pytest.approx(0.0, abs=30 * 0.23**2 * 2),
        ),
    ],
)
def test_a_movement_is_a_rotation_and_a_change_of_shape(after, rotation_deg, most_px) -> None:
    rotation_rad, left_px = movement(PRIOR, after)
    assert np.degrees(rotation_rad) == rotation_deg and left_px.max() == most_px


def test_a_camera_that_folds_over_is_refused() -> None:
    # 1 + 3 k1 r^2 is zero at r = 0.18: the corners have no line of sight.
    rotation_rad, left_px = movement(PRIOR, turned(0.0, k1=-10.0))
    assert np.isinf(rotation_rad) and np.isinf(left_px).all()
    folded = dataclasses.replace(GOOD, geometry=turned(0.0, k1=-10.0))
    options = limits_in(reasons(folded, GateOptions(), None))
    assert options == ['requirements', 'max_change_px']
