# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Temperature terms: recovery, errors within sigma, and terms that are none."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import each_image, errors_of, with_noise  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.assessment.observability import estimated_names, predicted_sigma
from starcal_ros.camera import CameraModel, PARAMETER_NAMES, project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.estimation.problem import geometry_at, reference_degc
from starcal_ros.records import ALIGNMENT_NAMES, Ensemble, StarObservations, TemperatureTerms

SCENARIO = scenario('tiny', seed=3)
TRUTH, PRIOR = SCENARIO.truth, SCENARIO.prior
TRACKER_ARCSEC = (10.0, 10.0, 40.0)
REFERENCE_DEGC = 10.0
TEMPERATURES_DEGC = np.array([-20.0, 12.0, -5.0, 31.0, 3.0, 40.0, -14.0, 22.0, 9.0, 35.0])
# A lens of a few 10^-5 per degree (0.4 px at the edge over 60 degrees), and a mount that turns by
# arcseconds per degree.
FOCAL = (4e-5, 6e-7)
RATE_RAD = np.array([4.0, -6.0, 20.0]) * ARCSECOND_RAD


def camera_of(temperature_degc: float, focal: tuple[float, ...]) -> CameraModel:
    dT = temperature_degc - REFERENCE_DEGC
    factor = 1.0 + sum(a * dT ** (k + 1) for k, a in enumerate(focal))
    fx, skew, fy = TRUTH.camera.parameters[:3] * factor
    return TRUTH.camera.replace(fx=fx, skew=skew, fy=fy)


def alignment_of(temperature_degc: float, rate_rad: np.ndarray) -> Rotation:
    """True camera_from_star_tracker at a temperature: a passive rotation from the reference."""
    dT = temperature_degc - REFERENCE_DEGC
    turn = Rotation.from_rotvec(-rate_rad * dT)
    return turn * TRUTH.star_tracker_from_camera.inv()


@functools.cache
def stars() -> tuple[StarObservations, ...]:
    """Ten images with every third star, of a camera that does not change."""
    images = true_observations(SCENARIO, centroid_noise=False, attitude_noise=False).images
    return tuple(image.select(np.arange(len(image)) % 3 == 0) for image in images)


def observed(
    focal: tuple[float, ...] = FOCAL,
    rate_rad: np.ndarray = RATE_RAD,
    temperatures_degc: np.ndarray = TEMPERATURES_DEGC,
    seed: int | None = None,
) -> Ensemble:
    """Observations with the temperature-dependent camera; noise if a seed is given."""

    def at_temperature(k: int, image: StarObservations) -> dict[str, object]:
        degc = float(temperatures_degc[k])
        star_tracker_from_icrf = Rotation.from_quat(image.icrf_from_star_tracker_xyzw).inv()
        camera_from_icrf = alignment_of(degc, rate_rad) * star_tracker_from_icrf
        pixels = project(camera_of(degc, focal), camera_from_icrf.apply(image.direction_icrf))
        return {'measured_px': pixels, 'temperature_degc': degc}

    exact: Ensemble = each_image(Ensemble(stars()), at_temperature)
    return exact if seed is None else with_noise(exact, seed, TRACKER_ARCSEC)


def with_temperatures(ensemble: Ensemble, degc: np.ndarray) -> Ensemble:
    return each_image(ensemble, lambda k, _: {'temperature_degc': float(degc[k])})  # type: ignore[no-any-return]


def options(method: str = 'hierarchical', order: int = 2, **other: object) -> CalibrationOptions:
    values: dict[str, object] = {
        # Of a method that takes the star tracker as perfect, a perfect one.
        'star_tracker_sigma_arcsec': (1e-3,) * 3 if method == 'single' else TRACKER_ARCSEC,
        'star_tracker_slow_arcsec': 0.1,
        'velocity_sigma_m_s': 10.0,
        'focal_temperature_order': order,
        'alignment_temperature': method != 'per_image',
        **other,
    }
    return CalibrationOptions(method=method, **values)  # type: ignore[arg-type]


def sigmas_of(estimate: Estimate) -> dict[str, float]:
    """1-sigmas of the unknowns that the search moves, by name."""
    layout = estimate.linear.layout
    sigma = np.sqrt(np.diag(estimate.considered))
    return {layout.labels[k]: float(sigma[k]) for k in layout.in_state}


def found(ensemble: Ensemble, chosen: CalibrationOptions) -> tuple[Estimate, TemperatureTerms]:
    estimate = estimate_calibration(ensemble, PRIOR, chosen)
    assert estimate.termination == 'converged'
    assert estimate.thermal is not None
    return estimate, estimate.thermal


@pytest.mark.parametrize(
    ('temperatures_degc', 'expected'),
    [
        (TEMPERATURES_DEGC, 10.0),
        (np.array([-18.0, -12.0, np.nan]), -20.0),
        (np.full(3, 4.9), 0.0),
        (np.array([5.1]), 10.0),
        (np.full(2, np.nan), 0.0),  # no term is estimated then
    ],
)
def test_the_reference_is_the_multiple_of_ten_nearest_the_mean(
    temperatures_degc: np.ndarray, expected: float
) -> None:
    few = Ensemble(stars()[: len(temperatures_degc)])
    assert reference_degc(with_temperatures(few, temperatures_degc)) == expected


@pytest.mark.parametrize(
    ('method', 'order'), [('single', 1), ('hierarchical', 2), ('per_image', 2)]
)
def test_without_noise_the_truth_comes_back(method: str, order: int) -> None:
    rate = np.zeros(3) if method == 'per_image' else RATE_RAD
    estimate, terms = found(observed(FOCAL[:order], rate), options(method, order))
    assert estimate.kept.all() and terms.note == ''
    assert terms.reference_degc == REFERENCE_DEGC
    fx, edge = TRUTH.camera.parameters[0], 0.23 * TRUTH.camera.parameters[0]
    # 1e-6 px at the edge of the field: residuals are of 1e-9 px.
    error = errors_of(estimate, TRUTH)
    assert np.abs(error[:5]).max() < 1e-6 and np.abs(error[10:] * fx).max() < 1e-6
    dT = np.abs(TEMPERATURES_DEGC - REFERENCE_DEGC).max()
    for k, (got, true) in enumerate(zip(terms.focal_per_degc, FOCAL[:order], strict=True), 1):
        assert abs(got - true) * dT**k * edge < 1e-6
    if method != 'per_image':
        assert np.abs(terms.alignment_rate_rad_per_degc - RATE_RAD).max() * dT * fx < 1e-6
    assert np.abs(estimate.residual_px).max() < 1e-7
    # Each name has its own row: the sigmas of the terms are those of the whole covariance.
    sigma = sigmas_of(estimate)
    degrees = range(1, order + 1)
    assert terms.focal_per_degc_sigma == tuple(sigma[f'focal_temperature_{k}'] for k in degrees)
    rate_names = [f'{name}_temperature' for name in ALIGNMENT_NAMES if method != 'per_image']
    assert terms.alignment_rate_rad_per_degc_sigma == tuple(sigma[name] for name in rate_names)


def test_temperatures_that_nobody_asks_for_change_no_bit() -> None:
    plain = options(order=0, alignment_temperature=False)
    warm = observed((), np.zeros(3), seed=1)
    unknown = with_temperatures(warm, np.full(10, np.nan))
    one, other = (estimate_calibration(e, PRIOR, plain) for e in (warm, unknown))
    assert one.thermal is None
    # Asked for, but not to be had: said, and the same numbers.
    third, terms = found(unknown, options())
    assert terms.note == 'left out: 10 of 10 images have no temperature'

    def numbers(of: Estimate) -> list[bytes]:
        information = of.posterior.equations.information
        return [a.tobytes() for a in (of.geometry.camera.parameters, of.covariance, information)]

    assert numbers(other) == numbers(third) == numbers(one)


@pytest.mark.parametrize(
    ('temperatures', 'note'),
    [
        (np.where(np.arange(10) == 4, np.nan, TEMPERATURES_DEGC), '1 of 10 images have no temp'),
        (np.linspace(20.0, 21.0, 10), 'the temperatures spread by 0.32 degC, less than 1'),
        (np.repeat([0.0, 30.0], 5), '2 temperatures do not determine a polynomial of degree 2'),
    ],
)
def test_what_the_images_do_not_carry_is_left_out(temperatures: np.ndarray, note: str) -> None:
    ensemble = observed((), np.zeros(3), np.nan_to_num(temperatures), seed=1)
    _, terms = found(with_temperatures(ensemble, temperatures), options())
    assert not terms.focal_per_degc and not terms.alignment_rate_rad_per_degc
    assert note in terms.note


def test_a_changing_camera_fits_only_where_it_is_asked_for() -> None:
    noisy = observed(seed=1)
    estimate, _ = found(noisy, options())
    plain = options(order=0, alignment_temperature=False)
    without = estimate_calibration(noisy, PRIOR, plain)
    rms, more = (np.sqrt(np.mean(e.residual_px[e.kept] ** 2)) for e in (estimate, without))
    assert estimate.variance_factor == pytest.approx(1.0, abs=0.1)
    # Without the terms the images have shapes of their own, and the camera is known less well.
    assert without.posterior.shapes.amplitudes.likelihood_ratio > 50.0
    assert estimate.posterior.shapes.amplitudes.likelihood_ratio < 15.0
    assert more == pytest.approx(rms, rel=0.02)
    assert without.covariance[0, 0] > 4 * estimate.covariance[0, 0]


@pytest.mark.parametrize('method', ['hierarchical', 'per_image'])
def test_the_prediction_accounts_for_the_terms(method: str) -> None:
    rate_rad = np.zeros(3) if method == 'per_image' else RATE_RAD
    # With the principal point held: where it trades with an alignment that rotates, as in
    # `single`, the sigma of the rate depends on the rate, which a prediction takes as zero.
    estimate_names = ('fx', 'skew', 'fy', 'distortion')
    chosen = options(method, variance_components=False, estimate=estimate_names)
    ensemble = observed(FOCAL, rate_rad)
    estimate, terms = found(ensemble, chosen)
    assert terms.note == ''
    sigma = sigmas_of(estimate)
    names = estimated_names(chosen, 'plumb_bob')
    asked = estimated_parameters(chosen, 'plumb_bob')
    assert set(names) == {n for n in sigma if n not in PARAMETER_NAMES or n in asked}
    predicted = dict(zip(names, predicted_sigma(ensemble, TRUTH, chosen), strict=True))
    # A field and changes of the camera that the stars do not exclude are no part of a prediction.
    for name in (name for name in names if 'alignment' not in name):
        assert predicted[name] == pytest.approx(sigma[name], rel=0.25), name
    # They cost something, and what they cost is predicted.
    plain = dataclasses.replace(chosen, focal_temperature_order=0, alignment_temperature=False)
    assert predicted['fx'] > 1.02 * predicted_sigma(ensemble, TRUTH, plain)[names.index('fx')]


def test_terms_that_the_images_do_not_carry_are_infinite_and_cost_nothing() -> None:
    chosen, plain = options(), options(order=0, alignment_temperature=False)
    ensemble = observed(FOCAL, RATE_RAD, np.full(10, 15.0))
    names, sigma = estimated_names(chosen, 'plumb_bob'), predicted_sigma(ensemble, TRUTH, chosen)
    of_temperature = np.array(['temperature' in name for name in names])
    assert of_temperature.sum() == 5 and np.isinf(sigma[of_temperature]).all()
    np.testing.assert_array_equal(sigma[~of_temperature], predicted_sigma(ensemble, TRUTH, plain))


def test_the_camera_at_a_temperature() -> None:
    terms = TemperatureTerms(
        REFERENCE_DEGC, FOCAL, (1e-6, 1e-8), tuple(RATE_RAD.tolist()), (1e-6,) * 3
    )
    for degc in (-20.0, REFERENCE_DEGC, 35.0):
        got, expected = geometry_at(TRUTH, terms, degc), camera_of(degc, FOCAL)
        np.testing.assert_allclose(got.camera.parameters, expected.parameters, rtol=1e-15)
        turn = got.star_tracker_from_camera * alignment_of(degc, RATE_RAD)
        assert turn.magnitude() < 1e-15
    assert geometry_at(TRUTH, TemperatureTerms(REFERENCE_DEGC), 50.0) == TRUTH
    assert geometry_at(TRUTH, None, 50.0) is TRUTH
