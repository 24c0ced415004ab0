"""The gate: every limit trips by itself, with its own reason, and nothing that is NaN passes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.assessment.agreement import Difference, movement
from starcal_ros.assessment.gate import Candidate, GateOptions, judge, reasons_of
from starcal_ros.camera import CameraModel
from starcal_ros.estimation.calibrate import CalibrationOptions
from starcal_ros.options import names_of
from starcal_ros.records import CameraGeometry, GateCheck

CAMERA = CameraModel(
    640, 512, np.array([1800, 0.2, 1801, 320, 255, -0.045, 0.08, 0.0, 4e-4, -3e-4])
)
MOUNTING = Rotation.from_euler('zyx', [-91.0, -28.0, 3.0], degrees=True)
PRIOR = CameraGeometry(CAMERA, MOUNTING.as_quat())
GOOD = Candidate(
    geometry=PRIOR,
    prior=PRIOR,
    covariance=np.diag(np.full(13, 1e-8)),
    residual_rms_px=0.1,
    images_used=20,
    images_misfit=1,
    stars_used=990,
    stars_rejected=10,
    coverage=np.ones((8, 10), np.int64),
    map_sigma_px=0.01,
    line_of_sight_sigma_arcsec=2.0,
    singular_value=0.02,
    zero_skew_cost_px=0.1,
    star_tracker_excess=1.0,
    termination='converged',
    halves=Difference(1e-5, 0.05, 8.0, 8, 11.0, 11),
    step=Difference(1e-4, 0.5, 32.0, 8, 44.0, 11),
)


def reasons(candidate: Candidate, options: GateOptions) -> tuple[str, ...]:
    return reasons_of(judge(candidate, options, CalibrationOptions()))


def checks(candidate: Candidate, options: GateOptions) -> dict[str, GateCheck]:
    """By the parameter that limits them, those without one by their name."""
    found = judge(candidate, options, CalibrationOptions())
    return {check.option or check.name: check for check in found}


def only(axis: int, limit: float) -> tuple[float, ...]:
    """Limits of the parameter sigmas: of one alone."""
    return tuple(limit if k == axis else 0.0 for k in range(13))


def turned(degrees: float, axis: str = 'x', **parameters: float) -> CameraGeometry:
    rotation = MOUNTING * Rotation.from_euler(axis, degrees, degrees=True)
    return CameraGeometry(CAMERA.replace(**parameters), rotation.as_quat())


def half_covered() -> np.ndarray:
    cells = np.zeros((8, 10), np.int64)
    cells[:4] = 7
    return cells


def test_a_good_candidate_passes() -> None:
    assert reasons(GOOD, GateOptions()) == ()


@pytest.mark.parametrize(
    ('changes', 'limit', 'at_limit', 'beyond', 'reason'),
    [
        (
            {'residual_rms_px': 0.8},
            'max_residual_rms_px',
            0.8,
            0.79,
            'residual per axis is 0.8 px, over the limit of 0.79 px (max_residual_rms_px)',
        ),
        (
            {'stars_used': 90, 'stars_rejected': 10},
            'max_rejected_fraction',
            0.1,
            0.099,
            (
                'fraction of stars left out as outliers is 0.1, over the limit of 0.099 '
                '(max_rejected_fraction)'
            ),
        ),
        (
            {'coverage': half_covered()},
            'min_coverage',
            0.5,
            0.51,
            (
                'fraction of the detector with stars that fit is 0.5, under the limit of 0.51 '
                '(min_coverage)'
            ),
        ),
        (
            {'map_sigma_px': 0.4},
            'max_map_sigma_px',
            0.4,
            0.39,
            (
                '1-sigma of the distortion map at its worst is 0.4 px, over the limit of 0.39 px '
                '(max_map_sigma_px)'
            ),
        ),
        (
            {'geometry': turned(1.0)},
            'max_turn_deg',
            1.0001,
            0.999,
            (
                'turn of the lines of sight from the prior is 1 deg, over the limit of 0.999 deg '
                '(max_turn_deg)'
            ),
        ),
        (
            {'images_misfit': 6},
            'max_misfit_fraction',
            0.3,
            0.29,
            (
                'fraction of images whose attitude does not fit is 0.3, over the limit of 0.29 '
                '(max_misfit_fraction)'
            ),
        ),
        (
            {'star_tracker_excess': 3.0},
            'max_star_tracker_excess',
            3.0,
            2.5,
            (
                '1-sigma of the star tracker, found over given, at its worst is 3, over the limit '
                'of 2.5 (max_star_tracker_excess)'
            ),
        ),
        (
            {'line_of_sight_sigma_arcsec': 20.0},
            'max_line_of_sight_sigma_arcsec',
            20.0,
            19.0,
            (
                '1-sigma of a line of sight at its worst is 20 arcsec, over the limit of 19 '
                'arcsec (max_line_of_sight_sigma_arcsec)'
            ),
        ),
        (
            {'covariance': np.diag([4.0, *[1e-8] * 12])},
            'max_parameter_sigma',
            only(0, 2.0),
            only(0, 1.9),
            '1-sigma of fx is 2 px, over the limit of 1.9 px (max_parameter_sigma)',
        ),
        (  # 1e-4 rad are 20.6 arcsec
            {},
            'max_parameter_sigma',
            only(12, 21.0),
            only(12, 20.0),
            (
                '1-sigma of alignment_z is 20.63 arcsec, over the limit of 20 arcsec '
                '(max_parameter_sigma)'
            ),
        ),
        (
            {'singular_value': 1e-3},
            'min_singular_value',
            1e-3,
            2e-3,
            ('smallest singular value is 0.001, under the limit of 0.002 (min_singular_value)'),
        ),
        (
            {'zero_skew_cost_px': 0.7},
            'max_zero_skew_cost_px',
            0.7,
            0.6,
            (
                'error of camera_info, which has no skew, at its worst is 0.7 px, over the limit '
                'of 0.6 px (max_zero_skew_cost_px)'
            ),
        ),
        (
            {'halves': Difference(1e-5, 0.6, 60.0, 8, 60.0, 11)},
            'max_halves_px',
            0.6,
            0.5,
            (
                'change of the distortion map between the halves of the images is 0.6 px, over '
                'the limit of 0.5 px (max_halves_px); the chance of as much is 5e-10, under '
                '0.0001 (min_halves_chance)'
            ),
        ),
        (
            {'halves': Difference(1e-4, 0.1, 8.0, 8, 60.0, 11)},
            'max_halves_turn_arcsec',
            20.7,
            20.0,
            (
                'turn between the halves of the images is 20.63 arcsec, over the limit of 20 '
                'arcsec (max_halves_turn_arcsec); the chance of as much is 9e-09, under 0.0001 '
                '(min_halves_chance)'
            ),
        ),
        (
            {'halves': Difference(1e-5, 1.6, 20.0, 8, 21.0, 11)},
            'min_halves_chance',
            1e-2,
            2e-2,
            (
                'change of the distortion map between the halves of the images is 1.6 px, over '
                'the limit of 1 px (max_halves_px); the chance of as much is 0.01, under 0.02 '
                '(min_halves_chance)'
            ),
        ),
        (
            {'step': Difference(1e-4, 4.0, 32.0, 8, 44.0, 11)},
            'max_step_px',
            4.0,
            3.5,
            (
                'change of the distortion map from the calibration in force at its worst is 4 px, '
                'over the limit of 3.5 px (max_step_px)'
            ),
        ),
        (
            {'step': Difference(np.radians(0.2), 0.1, 32.0, 8, 44.0, 11)},
            'max_step_turn_deg',
            0.2001,
            0.19,
            (
                'turn of the lines of sight from the calibration in force is 0.2 deg, over the '
                'limit of 0.19 deg (max_step_turn_deg)'
            ),
        ),
        (
            {},
            'max_step_sigma',
            2.0,
            1.9,
            (
                'change of what is estimated from the calibration in force is 2 sigma, over the '
                'limit of 1.9 sigma (max_step_sigma)'
            ),
        ),
        (
            {'geometry': turned(0.0, fx=1818.0, fy=1819.01)},
            'max_change_px',
            4.1,
            3.0,
            (
                'change of the distortion map from the prior at its worst is 3.916 px, over the '
                'limit of 3 px (max_change_px)'
            ),
        ),
    ],
)
def test_each_limit_trips_alone(
    changes: dict[str, Any], limit: str, at_limit: Any, beyond: Any, reason: str
) -> None:
    candidate = dataclasses.replace(GOOD, **changes)
    assert reasons(candidate, GateOptions(**{limit: at_limit})) == ()
    assert reasons(candidate, GateOptions(**{limit: beyond})) == (reason,)


def test_what_is_left_must_be_enough() -> None:
    """The fewest images and stars hold for what fits, not for what was collected."""
    options = GateOptions(max_misfit_fraction=1.0)
    candidate = dataclasses.replace(GOOD, images_misfit=18, stars_used=50, stars_rejected=0)
    assert reasons(candidate, options) == (
        'number of images that fit is 2, under the limit of 3 (min_images)',
        'number of stars that fit is 50, under the limit of 60 (min_stars)',
    )


def test_what_cannot_be_compared_is_not_held_against_it() -> None:
    strict = GateOptions(
        max_halves_px=0.0, max_halves_turn_arcsec=0.0, min_halves_chance=1.0, max_step_px=0.0
    )
    candidate = dataclasses.replace(GOOD, halves='5 images', step=None)
    assert reasons(candidate, strict) == ()
    found = checks(candidate, strict)
    none = 'no calibration was in force'
    notes = {option: check.note for option, check in found.items() if check.kept is None}
    assert notes == {
        'max_halves_px': '5 images',
        'max_halves_turn_arcsec': '5 images',
        'max_step_px': none,
        'max_step_turn_deg': none,
        'max_step_sigma': 'no limit is set',
    }
    assert all(np.isnan(found[option].found) for option in notes)
    assert found['max_step_px'].found_text == '' and found['max_step_px'].limit_text == '0 px'


def test_every_limit_has_its_check() -> None:
    """With the limit as the option has it; a chance stands with what it excuses."""
    options = GateOptions(max_parameter_sigma=only(0, 2.0), max_step_sigma=3.0)
    found = checks(GOOD, options)
    assert all(check.kept for check in found.values())
    limited = {name for name in found if found[name].option}
    assert limited == names_of(GateOptions) - {'min_halves_chance'} | {'min_images', 'min_stars'}
    for name in limited - {'min_images', 'min_stars', 'max_parameter_sigma'}:
        assert found[name].limit == getattr(options, name)
    assert 'min_halves_chance' in found['max_halves_px'].note


def test_large_counts_are_written_out() -> None:
    found = checks(dataclasses.replace(GOOD, stars_used=123456), GateOptions())['min_stars']
    assert (found.found_text, found.limit_text) == ('123456', '60')


def test_halves_that_differ_by_chance_or_by_little_pass() -> None:
    unlikely = Difference(1e-6, 0.1, 90.0, 8, 99.0, 11)
    large = Difference(1e-3, 2.0, 9.0, 8, 12.0, 11)
    for halves in (unlikely, large):
        assert reasons(dataclasses.replace(GOOD, halves=halves), GateOptions()) == ()


def test_a_search_that_did_not_converge_is_refused() -> None:
    for termination in ('no_descent', 'iteration_limit'):
        candidate = dataclasses.replace(GOOD, termination=termination)
        expected = (f'the solver did not converge ({termination})',)
        assert reasons(candidate, GateOptions()) == expected


def test_every_reason_is_given() -> None:
    candidate = dataclasses.replace(
        GOOD,
        residual_rms_px=9.0,
        stars_rejected=5000,
        coverage=np.zeros((8, 10), np.int64),
        map_sigma_px=9.0,
        termination='no_descent',
        geometry=turned(5.0, k1=6.0),
    )
    assert len(reasons(candidate, GateOptions())) == 7


def not_finite(name: str, bad: float) -> Candidate:
    """The good candidate with one number spoilt."""
    if name.startswith('covariance'):
        covariance = GOOD.covariance.copy()
        place = (5, 5) if name.endswith('diagonal') else (5, 11)
        covariance[place] = bad
        return dataclasses.replace(GOOD, covariance=covariance)
    if name == 'quaternion':
        broken = CameraGeometry(CAMERA, np.array([bad, 0.0, 0.0, 1.0]))
        return dataclasses.replace(GOOD, geometry=broken)
    return dataclasses.replace(GOOD, **{name: bad})  # type: ignore[arg-type]


@pytest.mark.parametrize('bad', [np.nan, np.inf])
@pytest.mark.parametrize('name', ['covariance diagonal', 'map_sigma_px'])
def test_what_is_not_finite_is_refused(name: str, bad: float) -> None:
    assert reasons(not_finite(name, bad), GateOptions())


@pytest.mark.parametrize('name', ['residual_rms_px', 'covariance', 'quaternion'])
def test_nothing_that_is_nan_passes(name: str) -> None:
    assert reasons(not_finite(name, np.nan), GateOptions())


def test_an_infinite_residual_is_refused() -> None:
    assert reasons(not_finite('residual_rms_px', np.inf), GateOptions())


def test_a_negative_variance_is_refused() -> None:
    covariance = GOOD.covariance.copy()
    covariance[3, 3] = -1e-9
    candidate = dataclasses.replace(GOOD, covariance=covariance)
    assert reasons(candidate, GateOptions()) == ('a variance is negative',)


def test_no_star_at_all_is_refused() -> None:
    candidate = dataclasses.replace(
        GOOD, stars_used=0, stars_rejected=0, coverage=np.zeros((8, 10), np.int64)
    )
    assert any('min_coverage' in reason for reason in reasons(candidate, GateOptions()))


@pytest.mark.parametrize('axis', ['x', 'y', 'z'])
@pytest.mark.parametrize('degrees', [0.01, 1.0, 30.0, 170.0])
def test_a_turn_is_a_turn_and_no_change_of_shape(axis: str, degrees: float) -> None:
    turn_rad, left_px = movement(PRIOR, turned(degrees, axis))
    assert np.degrees(turn_rad) == pytest.approx(degrees, abs=1e-7)
    assert left_px.max() < 1e-6


def test_a_focal_length_is_a_change_of_shape() -> None:
    # 1 % at the corner, 1800 px * 0.01 * 0.227 = 4.1 px; the field curves a little of it away.
    turn_rad, left_px = movement(PRIOR, turned(0.0, fx=1818.0, fy=1819.01))
    assert left_px.max() == pytest.approx(4.1, abs=0.4)
    assert np.degrees(turn_rad) < 0.01


def test_a_principal_point_is_mostly_a_turn() -> None:
    # 30 px of 1800 are 0.955 degrees.
    turn_rad, left_px = movement(PRIOR, turned(0.0, cx=350.0))
    assert np.degrees(turn_rad) == pytest.approx(0.955, abs=0.03)
    assert left_px.max() < 30 * 0.23**2 * 2


def test_a_camera_that_folds_over_is_refused() -> None:
    # 1 + 3 k1 r^2 is zero at r = 0.18: the corners have no line of sight.
    turn_rad, left_px = movement(PRIOR, turned(0.0, k1=-10.0))
    assert np.isinf(turn_rad) and np.isinf(left_px).all()
    found = reasons(dataclasses.replace(GOOD, geometry=turned(0.0, k1=-10.0)), GateOptions())
    assert len(found) == 2
