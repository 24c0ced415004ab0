# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The search against SciPy: the same cost from the formulas, minimised densely.

Prediction is OpenCV's, rotations are SciPy's, derivatives are numerical: nothing is shared with
the package but the data and the weights.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from worlds import each_image  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.estimation.problem import Problem
from starcal_ros.estimation.search import minimise, Minimum, problem_of, start_of
from starcal_ros.estimation.star_equations import arrange, star_table
from starcal_ros.records import Ensemble, StarObservations
from studies.trials import shared_covariance

Residuals = Callable[[np.ndarray], np.ndarray]

SCENARIO = scenario('tiny', seed=5)
TRACKER_ARCSEC = (10.0, 10.0, 40.0)  # its axes are told apart
EIGHT = CalibrationOptions(
    estimate=('fx', 'skew', 'fy', 'distortion'),
    principal_point_prior=0.0,
    lens_prior=0.0,
    star_tracker_sigma_arcsec=TRACKER_ARCSEC,
)
FREE = [
    k for k, name in enumerate(PARAMETER_NAMES) if name in estimated_parameters(EIGHT, 'plumb_bob')
]
THERMAL = dataclasses.replace(EIGHT, focal_temperature_order=2, alignment_temperature=True)


@functools.cache
def ensemble() -> Ensemble:
    """Five of the images with every third star."""
    images = true_observations(SCENARIO).images[::2]
    return Ensemble(
        tuple(image.select(np.arange(len(image)) % 3 == k % 3) for k, image in enumerate(images))
    )


@functools.cache
def warm() -> Ensemble:
    """The same with temperatures, whose camera and alignment change with them."""
    A = SCENARIO.truth.star_tracker_from_camera.inv()
    centre_px = SCENARIO.truth.camera.parameters[3:5]
    above_k = (-30.0, 10.0, -12.0, 25.0, 3.0)

    def warmed(k: int, image: StarObservations) -> dict[str, object]:
        dT = above_k[k]
        turn = Rotation.from_rotvec(-np.array([1e-5, -2e-5, 1e-4]) * dT)
        reported = Rotation.from_quat(image.icrf_from_star_tracker_xyzw) * (A.inv() * turn * A)
        factor = 1.0 + 5e-5 * dT + 2e-6 * dT**2
        return {
            # fx, skew and fy together scale the image about the principal point.
            'measured_px': centre_px + factor * (image.measured_px - centre_px),
            'icrf_from_star_tracker_xyzw': reported.as_quat(),
            'temperature_degc': 20.0 + dT,
        }

    return each_image(ensemble(), warmed)  # type: ignore[no-any-return]


def searched(given: Ensemble, options: CalibrationOptions) -> tuple[Problem, Minimum]:
    problem = problem_of(given, SCENARIO.prior, options)
    order, with_rate = options.focal_temperature_order, options.alignment_temperature
    start = start_of(problem, SCENARIO.prior, order, with_rate)
    table = star_table(given.images)
    measurements = arrange(table, np.ones(len(table), bool), table.covariance_px2)
    return problem, minimise(problem, start, measurements)


def predicted_px(parameters: np.ndarray, direction_camera: np.ndarray) -> np.ndarray:
    """Eqs. 6, 7 with the distortion of OpenCV."""
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    D = np.array([k1, k2, p1, p2, k3])
    x, y = cv2.projectPoints(direction_camera, np.zeros(3), np.zeros(3), np.eye(3), D)[0].T[:, 0]
    return np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1)


def numerical(given: Ensemble, minimum: Minimum) -> Residuals:
    """
    All weighted residuals as a function of the steps from the minimum.

    Unknowns: free camera parameters, focal terms, alignment and its rate, rotation of each image;
    the angles are passive rotations (Eq. 11).
    """
    state, table = minimum.state, star_table(given.images)
    f, q, axes = len(FREE), len(state.focal), len(state.rate)
    measured = [Rotation.from_quat(i.icrf_from_star_tracker_xyzw).inv() for i in given.images]
    C = table.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    root_weight = np.linalg.cholesky(np.linalg.inv(C)).transpose(0, 2, 1)
    sigma_rad = np.array(TRACKER_ARCSEC) * ARCSECOND_RAD

    def residuals(step: np.ndarray) -> np.ndarray:
        parameters = state.parameters.copy()
        parameters[FREE] += step[:f]
        turn = Rotation.from_rotvec(-step[f + q : f + q + 3])
        at_reference = turn * state.camera_from_star_tracker
        turns = step[f + q + 3 + axes :].reshape(-1, 3)
        focal = state.focal + step[f : f + q]
        rate = state.rate + step[f + q + 3 : f + q + 3 + axes]
        out = []
        for k, image in enumerate(given.images):
            own, alignment = parameters.copy(), at_reference
            dT = image.temperature_degc - 20.0
            if q:
                own[:3] *= 1.0 + focal @ [dT, dT * dT][:q]
            if axes:
                alignment = Rotation.from_rotvec(-rate * dT) * alignment
            rotation = Rotation.from_rotvec(-turns[k]) * state.camera_from_icrf[k]
            mine = table.image == k
            r = table.measured_px[mine] - predicted_px(
                own, rotation.apply(table.direction_icrf[mine])
            )
            out.append(np.einsum('nij,nj->ni', root_weight[mine], r).ravel())
            # The error of the tracker: its frame as reported from its frame in truth.
            error = measured[k] * rotation.inv() * alignment
            out.append(error.as_rotvec() / sigma_rad)
        return np.concatenate(out)

    return residuals


def jacobian(residuals: Residuals, unit: np.ndarray) -> np.ndarray:
    """Central differences of fourth order, each unknown in steps of its own unit."""
    columns = []
    for k in range(len(unit)):
        h = unit * (np.arange(len(unit)) == k)
        columns.append(
            (8 * (residuals(h) - residuals(-h)) - residuals(2 * h) + residuals(-2 * h)) / 12
        )
    return np.asarray(np.stack(columns, axis=-1) / unit)


def unit_of(minimum: Minimum, images: int) -> np.ndarray:
    """About one sigma of each unknown."""
    sigma = np.sqrt(np.diag(shared_covariance(minimum.normal)))
    angle = sigma[len(FREE) + len(minimum.state.focal) :][:3].min()
    return np.asarray(np.r_[sigma, np.full(3 * images, angle)])


def test_the_same_minimum() -> None:
    _, minimum = searched(ensemble(), EIGHT)
    residuals, unit = numerical(ensemble(), minimum), unit_of(minimum, 5)
    # SciPy starts several sigma away in every unknown, and searches in units of sigma.
    start = 10.0 * np.random.default_rng(1).normal(size=len(unit))
    found = least_squares(
        lambda x: residuals(x * unit), start, method='trf', x_scale='jac', jac='3-point',
        xtol=1e-15, ftol=1e-15, gtol=1e-15, max_nfev=200,
    )  # fmt: skip
    J = jacobian(residuals, unit) * unit
    sigma = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    # The numerical derivatives leave SciPy within 1e-4 sigma of its minimum.
    assert np.abs(found.x / sigma).max() < 1e-3
    at_minimum = 0.5 * float((residuals(np.zeros(len(unit))) ** 2).sum())
    assert at_minimum <= found.cost * (1 + 1e-9)
    assert minimum.normal.cost == pytest.approx(at_minimum, rel=1e-9)


@pytest.mark.parametrize('thermal', [False, True])
def test_the_same_covariance(thermal: bool) -> None:
    given, options = (warm(), THERMAL) if thermal else (ensemble(), EIGHT)
    _, minimum = searched(given, options)
    residuals, unit = numerical(given, minimum), unit_of(minimum, 5)
    J = jacobian(residuals, unit) * unit
    dense = np.linalg.inv(J.T @ J)
    # One Gauss-Newton step of the dense problem goes nowhere: the same minimum.
    step = dense @ (J.T @ residuals(np.zeros(len(unit)))) / np.sqrt(np.diag(dense))
    assert np.abs(step).max() < 1e-4
    ours = shared_covariance(minimum.normal)
    n = len(ours)
    dense = (dense * np.outer(unit, unit))[:n, :n]
    sigma = np.sqrt(np.diag(dense))
    # Fourth-order differences of 1 sigma steps: 1e-9 relative, times the condition number; eta^2
    # / 12 that is left out of the derivative by the attitudes, 3e-9; the series of the turn by the
    # temperature ends at a twelfth of its square, (3e-3)^2.
    assert np.abs((ours - dense) / np.outer(sigma, sigma)).max() < (1e-5 if thermal else 1e-6)
