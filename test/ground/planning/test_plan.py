# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The next pointings of a campaign."""

import csv
import dataclasses
import json
import math

from mission_files import TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from worlds import each_image  # type: ignore[import-not-found]

from bench.frames import load_set_up
from starcal_ground.planning.plan import (
    Cone,
    expected_noise_px2,
    Plan,
    plan_pointings,
    PlanRequest,
    Pointing,
    prospect,
    target,
)
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import camera_from_icrf, Inertial, scenario
from starcal_ros.assessment.requirements import MAP
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import ALIGNMENT_NAMES, Ensemble


@pytest.fixture(scope='module')
def setup() -> Setup:
    return load_set_up(scenario('tiny'))


@pytest.fixture(scope='module')
def ensemble() -> Ensemble:
    return true_observations(scenario('tiny'))


@pytest.fixture(scope='module')
def planned(setup: Setup, ensemble: Ensemble) -> Plan:
    return plan_pointings(ensemble, setup, PlanRequest(4, 'map'))


def _taken(ensemble: Ensemble, planned: Plan) -> Ensemble:
    """Return the ensemble with the images of a plan, as the simulation takes them."""
    places = [step.pointing for step in planned.steps]
    base = scenario('tiny')
    attitudes = tuple((one.ra_deg, one.dec_deg, one.roll_deg) for one in places)
    more = true_observations(
        dataclasses.replace(
            base,
            pointing=Inertial(attitudes),
            image_count=len(attitudes),
            start_ns=base.start_ns + 10**12,
        )
    )
    return dataclasses.replace(ensemble, images=(*ensemble.images, *more.images))


def test_a_pointing_is_the_attitude_of_the_simulation() -> None:
    base = dataclasses.replace(scenario('tiny'), pointing=Inertial(((123.0, -45.0, 67.0),)))
    by_plan = Pointing(123.0, -45.0, 67.0).icrf_from_camera.inv().as_matrix()
    np.testing.assert_allclose(by_plan, camera_from_icrf(base, 0), atol=1e-12)  # rounding


def test_the_images_then_give_the_sigma_that_was_expected(setup, ensemble, planned) -> None:
    taken = _taken(ensemble, planned)
    for step, image in zip(planned.steps, taken.images[-4:], strict=True):
        # Stars near the limit of the detection are found or not.
        assert step.stars == pytest.approx(len(image), rel=0.1)
    then = estimate_calibration(taken, setup.prior, setup.calibration)
    reported = target(then, 'map').sigma(then.posterior.covariance)
    # Amplitudes that the new images determine otherwise: 5 %, the median of 20 missions of the
    # bench, whose worst, of larger amplitudes, is far more.
    assert planned.steps[-1].sigma == pytest.approx(reported, rel=0.15)
    assert reported < 0.8 * planned.sigma
    assert planned.name == 'map_rms_arcsec' and 0.0 < planned.sigma < 1.0


@pytest.mark.slow
@pytest.mark.parametrize('name', ['map', 'fx'])
def test_a_forecast_falls_and_depends_on_the_set_of_images_alone(setup, ensemble, name) -> None:
    """No draw decides: a sigma rises with no image, and equal images have equal effects."""
    here, there = Pointing(10.0, 40.0, 5.0), Pointing(200.0, -20.0, 70.0)

    def sigmas(*allowed: Pointing) -> list[float]:
        found = plan_pointings(ensemble, setup, PlanRequest(len(allowed), name, allowed))
        return [found.sigma, *(step.sigma for step in found.steps)]

    same, pair, back = sigmas(here, here, here), sigmas(here, there), sigmas(there, here)
    for each in (same, pair):
        assert (np.diff(each) < 0).all()
    assert same[1] == pytest.approx(sigmas(here)[1], rel=1e-9)  # rounding of the directions
    assert pair == pytest.approx(back, rel=1e-9)


def test_a_pointing_comes_back_only_where_no_other_helps_as_much(setup, ensemble) -> None:
    """Noise of the star tracker falls with any image; its slow error asks for other attitudes."""
    places = [step.pointing for step in plan_pointings(ensemble, setup, PlanRequest(6)).steps]
    assert len(set(places)) == 6


@pytest.mark.slow
def test_pointings_of_a_list_are_taken_once_and_obey_slew_and_exclusion(setup, ensemble) -> None:
    allowed = tuple(Pointing(10.0 * k, 20.0, 5.0) for k in range(12))
    avoid = (Cone(0.0, 20.0, 15.0),)
    request = PlanRequest(12, 'fx', allowed, avoid=avoid, largest_slew_deg=30.0)
    places = [step.pointing for step in plan_pointings(ensemble, setup, request).steps]
    assert len(set(places)) == len(places) > 1
    assert {one.ra_deg for one in places} <= {20.0 + 10.0 * k for k in range(10)}
    axes = np.array([one.icrf_from_camera.apply([0.0, 0.0, 1.0]) for one in places])
    apart_deg = np.degrees(np.arccos((axes[1:] * axes[:-1]).sum(axis=1)))
    assert (apart_deg <= 30.0).all()


@pytest.mark.slow
def test_pointings_within_a_cone_and_how_many_help(setup, ensemble) -> None:
    """Images of one star-poor field repeat what is known."""
    axis = Pointing(200.0, 50.0).icrf_from_camera.apply([0.0, 0.0, 1.0])
    for name, radius_deg, count in (('map', 25.0, 2), ('k1', 1.0, 40)):
        request = PlanRequest(count, name, within=Cone(200.0, 50.0, radius_deg))
        found = plan_pointings(ensemble, setup, request)
        for step in found.steps:
            boresight = step.pointing.icrf_from_camera.apply([0.0, 0.0, 1.0])
            assert math.degrees(math.acos(boresight @ axis)) <= radius_deg
    assert found.enough is not None and 1 < found.enough < 40


def test_a_request_without_a_meaning_a_pointing_or_an_estimate(setup, ensemble) -> None:
    with pytest.raises(OptionError, match='--avoid: ra_deg is nan, not within'):
        PlanRequest(1, avoid=(Cone(math.nan, 0.0, 5.0),))
    with pytest.raises(OptionError, match='--within: radius_deg is 200, not within 0 to 180'):
        PlanRequest(1, within=Cone(0.0, 0.0, 200.0))
    nowhere = PlanRequest(1, 'map', avoid=(Cone(0.0, 0.0, 180.0),))
    with pytest.raises(OptionError, match='no pointing that is allowed shows a star'):
        plan_pointings(ensemble, setup, nowhere)
    few = dataclasses.replace(ensemble, images=ensemble.images[:1])
    with pytest.raises(TooFewObservations):
        plan_pointings(few, setup, PlanRequest(1, 'map'))


_OPTIONS = CalibrationOptions()


def _estimate(images: Ensemble) -> Estimate:
    return estimate_calibration(images, scenario('tiny').prior, _OPTIONS)


@pytest.fixture(scope='module')
def first(ensemble: Ensemble) -> Estimate:
    return _estimate(dataclasses.replace(ensemble, images=ensemble.images[:8]))


def test_the_turn_of_a_camera_without_rates_stays_in_the_sigma(ensemble) -> None:
    """All images share it: more of them do not take it away, as was promised before."""
    still = each_image(ensemble, lambda *_: {'star_tracker_rate_rad_s': np.full(3, np.nan)})
    few = _estimate(dataclasses.replace(still, images=still.images[:8]))
    found, wanted = prospect(few, still.images[8:], _OPTIONS), target(few, 'fy')
    after = _estimate(still)
    reported = target(after, 'fy').sigma(after.posterior.covariance)
    expected = np.sqrt(found.variances([0, 1], wanted.squares))[2]
    assert expected == pytest.approx(reported, rel=0.15)  # as above


def test_the_best_candidate_is_the_one_whose_variance_is_least(ensemble, first) -> None:
    found = prospect(first, ensemble.images, _OPTIONS)
    wanted = target(first, MAP)
    every = np.ones(10, bool)
    each = [float(found.variances([k], wanted.squares)[-1]) for k in range(10)]
    best = found.best([], every, wanted.squares)
    assert best == int(np.argmin(each))
    without = every.copy()
    without[best] = False
    assert found.best([], without, wanted.squares) == int(np.argsort(each)[1])


def test_sigmas_have_the_names_and_units_of_requirements(first) -> None:
    """The map has a smaller sigma than lines of sight, which have the alignment."""
    covariance = first.posterior.covariance

    def planned(name: str, unit: str) -> float:
        wanted = target(first, name)
        assert wanted.name == name + unit
        return wanted.sigma(covariance)

    assert planned('map', '_rms_arcsec') < planned('line_of_sight', '_rms_arcsec')
    assert planned('pointing', '_arcsec') == planned('line_of_sight', '_rms_arcsec')
    names = (*first.geometry.camera.parameter_names, *ALIGNMENT_NAMES)
    sigma = dict(zip(names, np.sqrt(np.diag(first.covariance)), strict=True))
    for name, unit, expected in (
        ('k1', '', sigma['k1']),
        ('fx', '_px', sigma['fx']),
        ('f', '_rms_px', np.hypot(sigma['fx'], sigma['fy']) / np.sqrt(2.0)),
        ('alignment_y', '_arcsec', sigma['alignment_y'] / ARCSECOND_RAD),
    ):
        assert planned(name, unit) == pytest.approx(expected, rel=1e-9)  # rounding
    allowed = 'one of: line_of_sight, map, pointing, f, fx, .*, alignment_z, k1, k2, k3, p1, p2$'
    with pytest.raises(OptionError, match=f"^'k9' is not estimated; .* is {allowed}"):
        target(first, 'k9')


def test_expected_noise_is_that_of_stars_of_about_the_magnitude(first) -> None:
    table = first.table
    expected = expected_noise_px2(first, table.magnitude.astype(float))
    real = first.weights.variance_px2
    # Their information in all, which decides: to 5 %, of the steps between the groups.
    assert (1.0 / expected).sum() == pytest.approx((1.0 / real).sum(), rel=0.05)
    faint_first = expected_noise_px2(first, np.array([9.0, 6.0, 4.0]))
    assert (np.diff(faint_first) < 0).all()


@pytest.mark.slow
def test_the_table_and_the_file_of_the_command_say_the_same(
    tiny_products, tmp_path, starcal
) -> None:
    allowed, output = tmp_path / 'allowed.csv', tmp_path / 'plan.csv'
    allowed.write_text('ra_deg,dec_deg\n10,40\n100,-20\n200,50\n')
    observed = [tiny_products / 'observations.mcap', '--params', TINY / 'params.yaml']
    line = ['plan', *observed, '--pointings', allowed, '--images']
    shown = starcal(*line, 5, '--minimise', 'map', '-o', output).out.splitlines()
    with output.open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(float(row['ra_deg']) for row in rows) == [10.0, 100.0, 200.0]
    for step, row in zip(shown[2:], rows, strict=False):
        assert float(step.split()[-1]) == pytest.approx(float(row['map_rms_arcsec']), rel=1e-3)
    assert 'no other pointing can be reached after image 3' in shown
    content = json.loads(starcal(*line, 1, '--json').out)
    assert content['name'] == 'line_of_sight_rms_arcsec' and len(content['steps']) == 1
