# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibration with every lens model: exact without noise, within the reported covariance with."""

import dataclasses

from geometries import COEFFICIENTS, turned  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import displaced, estimated, observed, WIDTH  # type: ignore[import-not-found]

from bench.narrow import bound_px, scenario_of
from starcal_ground import calibrate
from starcal_ground.comparison import map_error_px
from starcal_ground.mission.export.camera_models import opencv_yaml
from starcal_ground.mission.export.request import Request
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario, scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.camera import CameraModel, lens
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.records import CameraGeometry, Ensemble

# Tens of degrees: in a narrow field the terms of these models cannot be told apart.
FOCAL_PX = 420.0
# On a field of 66 degrees the higher terms of the large models still trade with each other: they
# are held at the truth.
ESTIMATE = {
    'plumb_bob': ('fx', 'skew', 'fy', 'distortion'),
    'rational_polynomial': ('fx', 'skew', 'fy', 'k1', 'k2', 'p1', 'p2', 'k4'),
    'thin_prism': ('fx', 'skew', 'fy', 'k1', 'k2', 'p1', 'p2', 's1', 's3'),
    'tilted': ('fx', 'skew', 'fy', 'k1', 'k2', 'tau_x', 'tau_y'),
    'equidistant': ('fx', 'skew', 'fy', 'distortion'),
}
each_model = pytest.mark.parametrize('model', lens.LENSES)


def wide(model: str, seed: int = 3) -> Scenario:
    """The tiny scenario with a wide lens of a model, and a prior that is off."""
    tiny = scenario('tiny', seed=seed)
    camera = tiny.truth.camera
    parameters = np.r_[FOCAL_PX, 0.3, FOCAL_PX + 1.0, camera.parameters[3:5], COEFFICIENTS[model]]
    truth = dataclasses.replace(
        tiny.truth, camera=CameraModel(camera.width, camera.height, parameters, model)
    )
    return dataclasses.replace(tiny, truth=truth, magnitude_limit=5.5)


def prior_of(made: Scenario, model: str) -> CameraGeometry:
    """Focal length 2 % off, the estimated coefficients by a fifth, the mounting by 0.1 degrees."""
    off = Rotation.from_euler('xyz', [0.1, -0.1, 0.05], degrees=True)
    parameters = made.truth.camera.parameters.copy()
    names = made.truth.camera.parameter_names
    options = CalibrationOptions(estimate=ESTIMATE[model])
    for name in estimated_parameters(options, model):
        parameters[names.index(name)] *= 1.02 if name in ('fx', 'fy') else 0.8
    camera = dataclasses.replace(made.truth.camera, parameters=parameters)
    prior: CameraGeometry = turned(made.truth, off)
    return dataclasses.replace(prior, camera=camera)


def estimate_of(made: Scenario, model: str, ensemble: Ensemble) -> Estimate:
    options = CalibrationOptions(
        estimate=ESTIMATE[model], star_tracker_sigma_arcsec=made.star_tracker_sigma_arcsec
    )
    return estimate_calibration(ensemble, prior_of(made, model), options)


@each_model
def test_without_noise_the_truth_comes_back(model: str) -> None:
    made = wide(model)
    ensemble = true_observations(made, centroid_noise=False, attitude_noise=False)
    found = estimate_of(made, model, ensemble)
    assert found.termination == 'converged' and found.kept.all()
    assert np.abs(found.residual_px).max() < 1e-6
    assert map_error_px(found.geometry.camera, made.truth.camera) < 1e-6


@pytest.mark.parametrize('model', ['rational_polynomial', 'thin_prism', 'tilted'])
def test_all_coefficients_of_a_large_model_are_estimated(model: str) -> None:
    """Those of numerator and denominator trade with each other within their weak prior."""
    made = wide(model, seed=4)
    prior = prior_of(made, model)
    found = estimate_calibration(true_observations(made), prior, CalibrationOptions())
    assert found.termination == 'converged'
    camera = found.geometry.camera
    sigma_px = map_sigma_px(camera, found.map_covariance)
    assert map_error_px(camera, made.truth.camera) < 2.0 * np.sqrt(np.mean(sigma_px**2)) < 0.03


def below(ideal: Floats, coefficients: Floats) -> Floats:
    """Denominator of the division model of Fitzgibbon, which has one coefficient."""
    return np.asarray((1.0 + coefficients[0] * (ideal * ideal).sum(axis=-1))[..., None])


def division(ideal: Floats, coefficients: Floats) -> Floats:
    return np.asarray(ideal / below(ideal, coefficients))


def division_by_ideal(ideal: Floats, coefficients: Floats) -> Floats:
    outer = ideal[..., :, None] * ideal[..., None, :]
    d = below(ideal, coefficients)[..., None]
    return np.asarray(np.eye(2) / d - 2.0 * coefficients[0] * outer / d**2)


def division_by_coefficients(ideal: Floats, coefficients: Floats) -> Floats:
    r2 = (ideal * ideal).sum(axis=-1)[..., None]
    return np.asarray(np.moveaxis(-ideal * r2 / below(ideal, coefficients) ** 2, -1, 0)[:, None])


def test_a_lens_model_is_added_by_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """As CONTRIBUTING.md says, from outside of the package: calibrated on simulated stars."""
    row = lens.LensModel(
        'division',
        ('k1',),
        division,
        division_by_ideal,
        division_by_coefficients,
        lambda k: 1.0 / k if k > 0 else -1.0 / k if k < 0 else np.inf,
        'division',
        (0,),
        ("(x', y') = (x, y) / (1 + k1 r2)",),
    )
    monkeypatch.setitem(lens.LENSES, 'division', row)
    monkeypatch.setitem(COEFFICIENTS, 'division', [0.08])
    monkeypatch.setitem(ESTIMATE, 'division', ('fx', 'skew', 'fy', 'distortion'))
    made = wide('division')
    found = estimate_of(made, 'division', true_observations(made))
    camera = found.geometry.camera
    sigma_px = map_sigma_px(camera, found.map_covariance)
    # Errors of 1.2 of their sigma, rms over the detector, come by chance in one of ten.
    assert map_error_px(camera, made.truth.camera) < 2.0 * np.sqrt(np.mean(sigma_px**2)) < 0.05
    assert lens.from_ros_distortion('division', [0.08]) == ('division', np.array([0.08]))
    # OpenCV has no such model: the nearest one, with what that costs.
    prior = prior_of(made, 'division')
    whole = calibrate(true_observations(made).images, prior, estimate=ESTIMATE['division'])
    content = opencv_yaml(whole, Request())
    (text,) = content.files.values()
    assert 'lens_model: pinhole\n' in str(text) and 'cols: 12' in str(text)
    assert 'lens model division (here thin_prism)' in [loss.part for loss in content.losses]


def test_mirrored_images_are_named() -> None:
    given, ensemble = observed(3, images=6)

    def mirrored(pixels: Floats) -> Floats:
        return np.stack([WIDTH - 1 - 2.0 * pixels[:, 0], 0.0 * pixels[:, 1]], axis=-1)

    with pytest.raises(TooFewObservations, match='^the stars are those of a mirrored image'):
        estimated(given, displaced(ensemble, mirrored))


@pytest.mark.parametrize('field_deg', [0.3, 2.5])
def test_a_narrow_field_does_not_estimate_what_it_cannot_show(field_deg: float) -> None:
    """Free higher orders trade with the principal point: 1.5 to 4 bounds off, or not converged."""
    ratios = []
    for seed in range(4):
        given = scenario_of(field_deg, seed)
        found = estimate_calibration(true_observations(given), given.prior, CalibrationOptions())
        assert found.termination == 'converged'
        ratios.append(map_error_px(found.geometry.camera, given.truth.camera) / bound_px(given))
    assert np.sqrt(np.mean(np.square(ratios))) < 1.2
