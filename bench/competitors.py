# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
One least-squares problem of stars for several solvers: starcal, SciPy, OpenCV.

Method 1 (`per_image`): eight camera parameters (fixed principal point) and the rotation of
every image.  SciPy gets the analytic derivatives of `camera.project_jacobians`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.arrays import Floats
from starcal_ros.camera import PARAMETER_NAMES, project_jacobians, project_parameters
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import cross_matrix, Problem, State
from starcal_ros.estimation.search import minimise
from starcal_ros.estimation.star_equations import arrange, Measurements, star_table, StarTable
from starcal_ros.records import CameraGeometry, Ensemble
from studies.trials import shared_covariance

FREE = np.array([k for k, name in enumerate(PARAMETER_NAMES) if name not in ('cx', 'cy')])
SIGMA_PX = 0.1
TOLERANCE = 1e-12
_MAGNITUDE_LIMIT = 6.65  # leaves about 80 stars in an image


@dataclass(frozen=True)
class Case:
    """Data and the common start of the solvers; n stars in m images."""

    ensemble: Ensemble
    prior: CameraGeometry
    table: StarTable
    problem: Problem
    start: State

    @property
    def rows_of_images(self) -> list[slice]:
        """Rows of the table, image by image."""
        ends = np.cumsum([len(image) for image in self.ensemble.images])
        return [slice(int(a), int(b)) for a, b in zip(np.r_[0, ends[:-1]], ends, strict=True)]

    @property
    def measurements(self) -> Measurements:
        """All stars with their stated covariances."""
        return arrange(self.table, np.ones(len(self.table), bool), self.table.covariance_px2)

    def with_free(self, values: Floats) -> Floats:
        """Camera parameters (10,) of the start with other values (f,) of the free ones."""
        parameters = self.start.parameters.copy()
        parameters[self.problem.free] = values
        return parameters

    @property
    def sigma_px(self) -> Floats:
        """1-sigma (n, 2) of the centroids along both axes."""
        return np.asarray(np.sqrt(self.table.covariance_px2[:, [0, 2]]))


@dataclass(frozen=True)
class Answer:
    """Result of a solver: parameters (10,), rotations (m, 3, 3), and number of iterations."""

    parameters: Floats
    camera_from_icrf: Floats
    iterations: int


def make_ensemble(images: int) -> tuple[Ensemble, CameraGeometry]:
    """Observations of a campaign over one night, and the prior to start from."""
    base = scenario('paper')
    campaign = dataclasses.replace(
        base,
        image_count=images,
        cadence_s=86000.0 / images,
        magnitude_limit=_MAGNITUDE_LIMIT,
        truth=dataclasses.replace(base.truth, camera=base.truth.camera.replace(skew=0.0)),
    )
    return true_observations(campaign, centroid_sigma_px=SIGMA_PX), base.prior


def make_case(ensemble: Ensemble, prior: CameraGeometry, free: NDArray[np.int64] = FREE) -> Case:
    """Data of an ensemble for the solvers, which estimate the free camera parameters."""
    m = len(ensemble.images)
    star_tracker_from_icrf = Rotation.from_quat(
        np.array([image.icrf_from_star_tracker_xyzw for image in ensemble.images])
    ).inv()
    problem = Problem(
        method='per_image',
        model='plumb_bob',
        free=free,
        prior_parameters=prior.camera.parameters,
        prior_sigma=np.full(10, np.inf),
        star_tracker_from_icrf=star_tracker_from_icrf,
        # The others have no star tracker: ten degrees leave the images free of it.
        star_tracker_sigma_rad=np.full((m, 3), 36000.0 * ARCSECOND_RAD),
    )
    alignment = prior.star_tracker_from_camera.inv()
    start = State(prior.camera.parameters.copy(), alignment, alignment * star_tracker_from_icrf)
    return Case(ensemble, prior, star_table(ensemble.images), problem, start)


def solve_starcal(case: Case) -> Answer:
    """Plain Levenberg-Marquardt of the package."""
    solution = minimise(case.problem, case.start, case.measurements)
    assert solution.converged
    rotations = solution.state.camera_from_icrf.as_matrix()
    return Answer(solution.state.parameters, rotations, solution.iterations)


def covariance_of(case: Case, answer: Answer, scaled: bool = True) -> Floats:
    """Covariance (f, f) of the free parameters at a minimum, scaled by chi^2 per degree or not."""
    f, m = len(case.problem.free), case.table.image_count
    rotations = Rotation.from_matrix(answer.camera_from_icrf)
    state = State(answer.parameters, case.start.camera_from_star_tracker, rotations)
    normal = minimise(case.problem, state, case.measurements).normal
    factor = 2.0 * normal.cost / (2 * len(case.table) - f - 3 * m) if scaled else 1.0
    return factor * shared_covariance(normal)[:f, :f]


def estimate_starcal(case: Case) -> Answer:
    """Complete estimate: robust search, outlier tests, variance components, covariance."""
    options = CalibrationOptions(method='per_image', star_tracker_sigma_arcsec=(20.0,) * 3)
    found = estimate_calibration(case.ensemble, case.prior, options)
    rotations = found.linear.state.camera_from_icrf.as_matrix()
    return Answer(found.linear.state.parameters, rotations, found.iterations)


def _rotation_jacobian(theta: Floats) -> tuple[Floats, Floats]:
    """
    Rotations (m, 3, 3) by passive angles (m, 3), and the small rotation (m, 3, 3) by them.

    ``exp(-[theta + d]) = exp(-[L d]) exp(-[theta])``, L the left Jacobian of SO(3) at -theta.
    """
    angle2 = np.maximum((theta**2).sum(axis=-1), 1e-24)[:, None, None]
    angle, K = np.sqrt(angle2), cross_matrix(-theta)
    # 1 - cos as a square, to keep precision at small angles.
    versine = 2.0 * np.sin(0.5 * angle) ** 2 / angle2
    cubic = np.where(angle2 < 1e-8, 1.0 / 6.0, (angle - np.sin(angle)) / (angle * angle2))
    L = np.eye(3) + versine * K + cubic * K @ K
    return Rotation.from_rotvec(-theta).as_matrix(), L


def solve_scipy(case: Case) -> Answer:
    """SciPy's trust region with a sparse analytic Jacobian."""
    table, m = case.table, case.table.image_count
    free, sigma_px = case.problem.free, case.sigma_px
    f, n = len(free), len(table)
    base = np.einsum(
        'nij,nj->ni', case.start.camera_from_icrf.as_matrix()[table.image], table.direction_icrf
    )
    columns = np.empty((n, 2, f + 3), np.int32)
    columns[..., :f] = np.arange(f)
    columns[..., f:] = (f + 3 * table.image[:, None] + np.arange(3))[:, None]
    rows = np.arange(0, (f + 3) * (2 * n) + 1, f + 3)

    def residuals(x: Floats) -> Floats:
        rotation, _ = _rotation_jacobian(x[f:].reshape(m, 3))
        directions = np.einsum('nij,nj->ni', rotation[table.image], base)
        predicted = project_parameters('plumb_bob', case.with_free(x[:f]), directions)
        return np.asarray(((predicted - table.measured_px) / sigma_px).ravel())

    def jacobian(x: Floats) -> csr_matrix:
        rotation, L = _rotation_jacobian(x[f:].reshape(m, 3))
        directions = np.einsum('nij,nj->ni', rotation[table.image], base)
        camera = dataclasses.replace(case.prior.camera, parameters=case.with_free(x[:f]))
        _, J_parameters, J_rotation = project_jacobians(camera, directions)
        J = np.concatenate([J_parameters[..., free], J_rotation @ L[table.image]], axis=-1)
        J /= sigma_px[..., None]
        return csr_matrix((J.ravel(), columns.ravel(), rows), (2 * n, f + 3 * m))

    start = np.concatenate([case.start.parameters[free], np.zeros(3 * m)])
    tolerances = dict.fromkeys(('ftol', 'xtol', 'gtol'), TOLERANCE)
    inner = {'atol': 1e-9, 'btol': 1e-9}  # else its steps are inexact: 6 iterations instead of 4
    search = {'method': 'trf', 'x_scale': 'jac', 'tr_options': inner, **tolerances}
    found = least_squares(residuals, start, jacobian, **search)
    rotation, _ = _rotation_jacobian(found.x[f:].reshape(m, 3))
    rotations = rotation @ case.start.camera_from_icrf.as_matrix()
    return Answer(case.with_free(found.x[:f]), rotations, found.njev)


def solve_opencv(case: Case) -> Answer:
    """OpenCV calibration with five distortion coefficients, the principal point held."""
    # Its normal matrix is dense; the default, singular values, takes twice as long.
    K, D, rotations = calibrate_opencv(case, cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_USE_LU)
    k1, k2, p1, p2, k3 = D[:5]
    parameters = np.array([K[0, 0], 0.0, K[1, 1], K[0, 2], K[1, 2], k1, k2, k3, p1, p2])
    return Answer(parameters, rotations, 0)


def calibrate_opencv(case: Case, flags: int) -> tuple[Floats, Floats, Floats]:
    """
    Calibration of a camera from points in space: K (3, 3), D (d,), and camera_from_icrf (m, 3, 3).

    A star stands at two depths, as OpenCV places the camera as well as turns it: at one depth a
    shift would be as good as a rotation.  Its points are of single precision.
    """
    table, prior = case.table, case.prior.camera
    start = case.start.camera_from_icrf.as_matrix()
    points, pixels = [], []
    for stars, rotation in zip(case.rows_of_images, start, strict=True):
        near = table.direction_icrf[stars] @ rotation.T
        points.append(np.concatenate([near, 2.0 * near]).astype(np.float32))
        pixels.append(np.concatenate([table.measured_px[stars]] * 2).astype(np.float32))
    k1, k2, k3, p1, p2 = prior.distortion
    fx, _, fy, cx, cy = prior.intrinsics
    _, K, D, turns, _, _, _, _ = cv2.calibrateCameraExtended(
        *(points, pixels, (prior.width, prior.height)),
        *(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3])),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, TOLERANCE),
    )
    rotation = Rotation.from_rotvec(np.array(turns).reshape(-1, 3)).as_matrix()
    return np.asarray(K, np.float64), np.ravel(D).astype(np.float64), rotation @ start
