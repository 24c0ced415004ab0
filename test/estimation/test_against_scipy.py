# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The calibration against SciPy: the same cost from the formulas, minimised densely.

Prediction is OpenCV's, rotations are SciPy's, derivatives are numerical: nothing is shared with
the package but the data and the weights.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.records import Ensemble
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import scenario

Residuals = Callable[[np.ndarray], np.ndarray]

SCENARIO = scenario('tiny', seed=5)
TRACKER_ARCSEC = SCENARIO.star_tracker_sigma_arcsec  # (10, 10, 40): its axes are told apart
# The eight parameters of the paper, without a prior or a field, which the dense cost leaves out.
EIGHT = CalibrationOptions(
    estimate=('fx', 'skew', 'fy', 'distortion'), principal_point_prior=0.0, residual_field=False
)


@pytest.fixture(scope='module')
def ensemble() -> Ensemble:
    """Five of the images with every third star."""
    images = true_observations(SCENARIO).images[::2]
    return Ensemble(
        tuple(image.select(np.arange(len(image)) % 3 == k % 3) for k, image in enumerate(images))
    )


def predicted_px(parameters: np.ndarray, direction_camera: np.ndarray) -> np.ndarray:
    """Eqs. 6, 7 with the distortion of OpenCV."""
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = parameters
    D = np.array([k1, k2, p1, p2, k3])
    x, y = cv2.projectPoints(direction_camera, np.zeros(3), np.zeros(3), np.eye(3), D)[0].T[:, 0]
    return np.stack([fx * x + skew * y + cx, fy * y + cy], axis=-1)


def numerical(
    ensemble: Ensemble, estimate: Estimate, options: CalibrationOptions
) -> tuple[Residuals, list[int]]:
    """
    All weighted residuals of the method as a function of the steps from where the estimate is.

    Unknowns: free camera parameters, focal terms, alignment and its rate (not per image), rotation
    of each image (not single); the angles are passive rotations (Eq. 11).
    """
    free = [
        k
        for k, name in enumerate(PARAMETER_NAMES)
        if name in estimated_parameters(options, 'plumb_bob')
    ]
    f, m = len(free), len(ensemble.images)
    table, state = estimate.table, estimate.state
    q, axes = len(state.focal), len(state.rate)
    measured = [Rotation.from_quat(i.icrf_from_star_tracker_xyzw).inv() for i in ensemble.images]
    uu, uv, vv = estimate.variance.of(table.covariance_px2, table.magnitude).T
    C = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-2)
    root_weight = np.linalg.cholesky(np.linalg.inv(C)).transpose(0, 2, 1)

    def residuals(step: np.ndarray) -> np.ndarray:
        parameters = state.parameters.copy()
        parameters[free] += step[:f]
        at_reference = state.camera_from_star_tracker
        if options.method == 'per_image':
            turns = step[f + q :].reshape(m, 3)
        else:
            at_reference = Rotation.from_rotvec(-step[f + q : f + q + 3]) * at_reference
            turns = step[f + q + 3 + axes :].reshape(-1, 3)
        focal = state.focal + step[f : f + q]
        rate = state.rate + step[f + q + 3 : f + q + 3 + axes]
        out = []
        for k, image in enumerate(ensemble.images):
            own, alignment = parameters.copy(), at_reference
            dT = image.temperature_degc - options.reference_temperature_degc
            if q:
                own[:3] *= 1.0 + focal @ [dT, dT * dT][:q]
            if axes:
                alignment = Rotation.from_rotvec(-rate * dT) * alignment
            if options.method == 'single':
                rotation = alignment * measured[k]
            else:
                rotation = Rotation.from_rotvec(-turns[k]) * state.camera_from_icrf[k]
            mine = (table.image == k) & estimate.kept
            e = rotation.apply(table.direction_icrf[mine])
            r = table.measured_px[mine] - predicted_px(own, e)
            out.append(np.einsum('nij,nj->ni', root_weight[mine], r).ravel())
            if options.method == 'hierarchical':
                # The error of the tracker: its frame as reported from its frame in truth.
                error = measured[k] * rotation.inv() * alignment
                sigma_rad = np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD
                out.append(error.as_rotvec() / sigma_rad)
        return np.concatenate(out)

    return residuals, free


def jacobian(residuals: Residuals, unit: np.ndarray) -> np.ndarray:
    """Central differences of fourth order, each unknown in steps of its own unit."""
    columns = []
    for k in range(len(unit)):
        h = unit * (np.arange(len(unit)) == k)
        columns.append(
            (8 * (residuals(h) - residuals(-h)) - residuals(2 * h) + residuals(-2 * h)) / 12
        )
    return np.asarray(np.stack(columns, axis=-1) / unit)


def solved(
    ensemble: Ensemble, method: str
) -> tuple[Estimate, Residuals, CalibrationOptions, np.ndarray, list[int]]:
    """Estimate, residual function, options, a unit of about one sigma for each unknown, free."""
    options = dataclasses.replace(EIGHT, method=method, star_tracker_sigma_arcsec=TRACKER_ARCSEC)
    estimate = estimate_calibration(ensemble, SCENARIO.prior, options)
    residuals, free = numerical(ensemble, estimate, options)
    angles = {'single': 3, 'per_image': 3 * 5, 'hierarchical': 3 + 3 * 5}[method]
    sigma = np.sqrt(np.diag(estimate.covariance))
    unit = np.r_[sigma[free], np.full(angles, sigma[10:].min())]
    return estimate, residuals, options, unit, free


METHODS = ('per_image', 'single', 'hierarchical')


@pytest.mark.parametrize('method', METHODS)
def test_the_same_minimum(ensemble: Ensemble, method: str) -> None:
    _, residuals, _, unit, _ = solved(ensemble, method)
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
    at_estimate = 0.5 * float((residuals(np.zeros(len(unit))) ** 2).sum())
    assert at_estimate <= found.cost * (1 + 1e-9)


@pytest.mark.parametrize('method', METHODS)
def test_the_same_covariance(ensemble: Ensemble, method: str) -> None:
    estimate, residuals, options, unit, free = solved(ensemble, method)
    J = jacobian(residuals, unit) * unit
    dense = np.linalg.inv(J.T @ J) * np.outer(unit, unit)
    f = len(free)
    if method == 'per_image':
        dense = with_mean_alignment(dense, estimate, ensemble, options, f)
    rows = [*free, 10, 11, 12]
    ours = estimate.covariance[np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(dense[: f + 3, : f + 3]))
    difference = (ours - dense[: f + 3, : f + 3]) / np.outer(sigma, sigma)
    # Fourth-order differences of 1 sigma steps: 1e-9 relative, times the condition number.
    # The hierarchical method leaves eta^2 / 12 out of its derivative: 3e-9.
    assert np.abs(difference[:f, : f + 3]).max() < 1e-6
    # The images disagree by 40 arcsec, 2e-4 rad, about where the axes of the tracker lie.
    assert np.abs(difference).max() < (5e-4 if method == 'per_image' else 1e-6)


def with_mean_alignment(
    dense: np.ndarray,
    estimate: Estimate,
    ensemble: Ensemble,
    options: CalibrationOptions,
    f: int,
) -> np.ndarray:
    """Covariance of camera and weighted mean of the images' rotations, each with tracker noise."""
    A = Rotation.from_quat(estimate.geometry.star_tracker_from_camera_xyzw).inv().as_matrix()
    tracker = np.diag((np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD) ** 2)
    tracker = A @ tracker @ A.T
    m = len(ensemble.images)
    G = np.zeros((f + 3, f + 3 * m))
    G[:f, :f] = np.eye(f)
    blocks = [dense[f + 3 * k : f + 3 * k + 3, f + 3 * k : f + 3 * k + 3] for k in range(m)]
    weight = np.array([1 / np.trace(block + tracker) for block in blocks])
    weight /= weight.sum()
    for k in range(m):
        G[f:, f + 3 * k : f + 3 * k + 3] = weight[k] * np.eye(3)
    total = G @ dense @ G.T
    total[f:, f:] += (weight**2).sum() * tracker
    return np.asarray(total)


def test_per_image_alignment_is_the_weighted_mean(ensemble: Ensemble) -> None:
    estimate, residuals, options, unit, _ = solved(ensemble, 'per_image')
    J = jacobian(residuals, unit) * unit
    dense = np.linalg.inv(J.T @ J) * np.outer(unit, unit)
    tracker = np.mean((np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD) ** 2) * 3
    weight = np.array(
        [1 / (np.trace(dense[k : k + 3, k : k + 3]) + tracker) for k in range(8, 23, 3)]
    )
    alignments = estimate.state.camera_from_icrf * Rotation.from_quat(
        np.array([i.icrf_from_star_tracker_xyzw for i in ensemble.images])
    )
    found = Rotation.from_quat(estimate.geometry.star_tracker_from_camera_xyzw).inv()
    # Linear in angles of some 40 arcsec: 1e-4 of them squared is 1e-8 rad at most, far less here.
    mean = np.average((alignments * found.inv()).as_rotvec(), axis=0, weights=weight)
    assert np.linalg.norm(mean) < 1e-5 * ARCSECOND_RAD


def test_the_prior_of_the_tracker_is_in_the_cost(ensemble: Ensemble) -> None:
    # Tracker and stars: with a tighter tracker the alignment is another one.
    tight = dataclasses.replace(
        EIGHT,
        method='hierarchical',
        star_tracker_sigma_arcsec=(0.1, 0.1, 0.1),
        variance_components=False,
    )
    loose = dataclasses.replace(tight, star_tracker_sigma_arcsec=(3600.0, 3600.0, 3600.0))
    a, b = (estimate_calibration(ensemble, SCENARIO.prior, o).covariance for o in (tight, loose))
    assert a[10, 10] < 1e-3 * b[10, 10]


@pytest.mark.parametrize('method', ['single', 'hierarchical'])
def test_terms_of_temperature_have_the_same_minimum_and_covariance(
    ensemble: Ensemble, method: str
) -> None:
    options = dataclasses.replace(
        EIGHT,
        method=method,
        star_tracker_sigma_arcsec=TRACKER_ARCSEC,
        focal_temperature_order=2,
        alignment_temperature=True,
    )
    warm = []
    A = Rotation.from_quat(SCENARIO.truth.star_tracker_from_camera_xyzw).inv()
    centre_px = SCENARIO.truth.camera.parameters[3:5]
    for image, dT in zip(ensemble.images, (-30.0, 10.0, -12.0, 25.0, 3.0), strict=True):
        turn = Rotation.from_rotvec(-np.array([1e-5, -2e-5, 1e-4]) * dT)
        reported = Rotation.from_quat(image.icrf_from_star_tracker_xyzw) * (A.inv() * turn * A)
        factor = 1.0 + 5e-5 * dT + 2e-6 * dT**2
        warm.append(
            dataclasses.replace(
                image,
                # fx, skew and fy together scale the image about the principal point.
                measured_px=centre_px + factor * (image.measured_px - centre_px),
                icrf_from_star_tracker_xyzw=reported.as_quat(),
                temperature_degc=options.reference_temperature_degc + dT,
            )
        )
    estimate = estimate_calibration(Ensemble(tuple(warm)), SCENARIO.prior, options)
    terms = estimate.thermal
    assert terms is not None and terms.note == ''
    residuals, free = numerical(Ensemble(tuple(warm)), estimate, options)
    f, sigma = len(free), np.sqrt(np.diag(estimate.covariance))
    thermal_sigma = np.r_[terms.focal_per_degc_sigma, terms.alignment_rate_rad_per_degc_sigma]
    images = np.full(0 if method == 'single' else 3 * len(warm), sigma[10:].min())
    unit = np.r_[sigma[free], thermal_sigma[:2], sigma[10:], thermal_sigma[2:], images]
    J = jacobian(residuals, unit) * unit
    dense = np.linalg.inv(J.T @ J)
    # One Gauss-Newton step of the dense problem goes nowhere: the same minimum.
    step = dense @ (J.T @ residuals(np.zeros(len(unit)))) / np.sqrt(np.diag(dense))
    assert np.abs(step).max() < 1e-4
    dense *= np.outer(unit, unit)
    rows = [*range(f), f + 2, f + 3, f + 4]
    ours = estimate.covariance[np.ix_([*free, 10, 11, 12], [*free, 10, 11, 12])]
    scale = np.sqrt(np.diag(dense))
    difference = (ours - dense[np.ix_(rows, rows)]) / np.outer(scale[rows], scale[rows])
    # As above; the series of the turn ends at a twelfth of its square, (3e-3)^2.
    assert np.abs(difference).max() < 1e-5
    rows = [f, f + 1, f + 5, f + 6, f + 7]
    np.testing.assert_allclose(thermal_sigma, scale[rows], rtol=1e-5)
