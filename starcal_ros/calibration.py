"""
From an ensemble of observed images to camera, alignment and covariance (Eqs. 10-26).

Three methods share one solver and one set of normal matrices:

- ``per_image`` (the paper's Method 1): every image has its own rotation; the alignments found are
  averaged as quaternions.
- ``single`` (Method 2): one rotation for all images, the star tracker taken as perfect.
- ``hierarchical`` (beyond the paper): one common alignment, and for each image an attitude error
  of the star tracker's covariance.  The other two are its limits.

With R_k = camera_from_icrf of image k, the attitude error of the hierarchical method is
``eta_k = -Log(A' R_k T_k')``, a small rotation in the star tracker frame, where A =
camera_from_star_tracker and T_k = star_tracker_from_icrf as measured.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import TooFewObservations
from starcal_ros.least_squares import (
    covariance,
    levenberg_marquardt,
    NormalEquations,
    NotObservable,
    Solution,
)
from starcal_ros.measurement import (
    arrange,
    CAMERA,
    Measurements,
    normal_blocks,
    RESIDUAL,
    residuals_px,
    ROTATION,
    squared_sigmas,
    star_table,
    StarTable,
)
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry, Ensemble

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

METHODS = ('hierarchical', 'per_image', 'single')

_ROBUST_SCALE = (
    3.0  # of the Cauchy loss, in sigma: normal noise loses 5 % of its weight, outliers all
)
_START_FLOOR_PX = 0.05  # until the residuals tell: of the order of what is left in good images
_STARS_PER_GROUP = 40  # whose median squared residual is known to 25 %
_SNOOPING_ROUNDS = 10  # the set of rejected stars settles in two or three


@dataclass(frozen=True)
class CalibrationOptions:
    """What is estimated, and how."""

    method: str = option(
        'per_image', 'how the attitudes of the images are treated', choices=METHODS
    )
    estimate: tuple[str, ...] = option(
        ('fx', 'skew', 'fy', 'k1', 'k2', 'k3', 'p1', 'p2'),
        'camera parameters that are estimated; the others are held at the prior',
        choices=PARAMETER_NAMES,
    )
    star_tracker_sigma_arcsec: tuple[float, ...] = option(
        (10.0, 10.0, 10.0),
        '1-sigma of the star tracker attitude about its x, y, z axes, arcsec',
        low=1e-3,
        high=3600.0,
        length=3,
    )
    min_images: int = option(
        3, 'fewest images from which a calibration is made', low=1, high=100000
    )
    min_stars: int = option(
        60, 'fewest star observations from which a calibration is made', low=10, high=1000000
    )
    max_images: int = option(
        400, 'most images kept; beyond it those that add least information go', low=3, high=100000
    )
    outlier_sigma: float = option(
        4.5,
        'length of a residual, in its sigma, from which a star is left out',
        low=3.0,
        high=20.0,
    )


@dataclass(frozen=True)
class State:
    """Where the search stands: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (10,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)


@dataclass(frozen=True)
class Problem:
    """What one search is given; arrays over m images and n stars."""

    method: str
    free: NDArray[np.int64]  # estimated camera parameters
    star_tracker_from_icrf: Rotation  # (m,), as measured
    star_tracker_sigma_rad: Floats  # (3,)


@dataclass(frozen=True)
class CentroidVariance:
    """
    What the residuals say of the centroid covariances C: they are ``scale C + floor_px2 I``.

    The floor stands for what a centroid does not know of: the real shape of the PSF, the catalog,
    the air.  The scale is a wrong detector gain, or the excess of faint stars over their bound.
    """

    scale: float
    floor_px2: float

    def of(self, covariance_px2: Floats) -> Floats:
        """Covariances (n, 3) uu, uv, vv as the residuals have them."""
        return self.scale * covariance_px2 + self.floor_px2 * np.array([1.0, 0.0, 1.0])

    def is_close_to(self, other: CentroidVariance) -> bool:
        """Whether a weight changes by under 1 %, which moves no estimate by 0.001 sigma."""
        return math.isclose(self.scale, other.scale, rel_tol=0.01) and math.isclose(
            self.floor_px2, other.floor_px2, rel_tol=0.01, abs_tol=1e-8
        )


@dataclass(frozen=True)
class Estimate:
    """
    A solved calibration, before products.

    ``covariance`` (13, 13); ``kept`` (n,) stars used; ``variance`` how the centroid covariances
    were corrected; ``variance_factor`` chi^2 per degree of freedom of them as given;
    ``residual_px`` (n, 2) of all stars; ``alignment_scatter_arcsec`` of the images.
    """

    geometry: CameraGeometry
    covariance: Floats
    state: State
    table: StarTable
    kept: Mask
    residual_px: Floats
    variance: CentroidVariance
    variance_factor: float
    alignment_scatter_arcsec: float
    iterations: int
    termination: str


def check_enough(ensemble: Ensemble, options: CalibrationOptions) -> None:
    """
    Raise `TooFewObservations` that says how many images or stars are missing.

    Raises
    ------
    TooFewObservations
        A sentence for a person.
    """
    images, stars = len(ensemble.images), ensemble.star_count
    missing = []
    if images < options.min_images:
        missing.append(
            f'{options.min_images - images} more images are needed '
            f'({images} of {options.min_images} collected)'
        )
    if stars < options.min_stars:
        missing.append(
            f'{options.min_stars - stars} more stars are needed '
            f'({stars} of {options.min_stars} collected)'
        )
    if missing:
        refused = sum(ensemble.refused.values())
        also = f'; {refused} images were refused' if refused else ''
        raise TooFewObservations('too few observations: ' + ' and '.join(missing) + also)


def estimate_calibration(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Estimate:
    """
    Estimate of the camera parameters and the alignment from an ensemble.

    First with a robust loss from the prior; then least squares on the stars that fit, the
    variance of the centroids re-estimated, until the set of stars no longer changes.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars, or they do not determine what is to be estimated.
    """
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    alignment = Rotation.from_quat(prior.star_tracker_from_camera_xyzw).inv()
    star_tracker_from_icrf = Rotation.from_quat(
        np.array([image.icrf_from_star_tracker_xyzw for image in ensemble.images])
    ).inv()
    free = np.array([PARAMETER_NAMES.index(name) for name in options.estimate], np.int64)
    problem = Problem(
        options.method,
        np.sort(free),
        star_tracker_from_icrf,
        np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD,
    )
    state = State(prior.camera.parameters.copy(), alignment, alignment * star_tracker_from_icrf)
    try:
        return _search(problem, state, table, prior, options)
    except (NotObservable, np.linalg.LinAlgError) as error:
        names = ', '.join(options.estimate)
        raise TooFewObservations(
            f'the stars do not determine all of {names} and the alignment: {error}; '
            'more images, or stars over more of the detector, or fewer parameters are needed'
        ) from error


def _search(
    problem: Problem,
    state: State,
    table: StarTable,
    prior: CameraGeometry,
    options: CalibrationOptions,
) -> Estimate:
    """Robust search, then least squares with snooping; see `estimate_calibration`."""
    everything = np.ones(len(table), bool)
    start = CentroidVariance(1.0, _START_FLOOR_PX**2)
    solution = _minimise(
        problem, state, arrange(table, everything, start.of(table.covariance_px2)), _ROBUST_SCALE
    )
    iterations = solution.iterations
    residual_px = _residuals(solution.state, table)
    variance = estimate_variance(residual_px, table.covariance_px2, everything, 1.0)
    kept = _fitting(residual_px, table, variance, options)
    for _ in range(_SNOOPING_ROUNDS):
        covariance_px2 = variance.of(table.covariance_px2)
        solution = _minimise(problem, solution.state, arrange(table, kept, covariance_px2), np.inf)
        iterations += solution.iterations
        residual_px = _residuals(solution.state, table)
        kept_before, variance_before = kept, variance
        freedom = _degrees_of_freedom(problem, table, kept) / (2 * np.count_nonzero(kept))
        variance = estimate_variance(residual_px, table.covariance_px2, kept, freedom)
        kept = _fitting(residual_px, table, variance, options)
        if np.array_equal(kept, kept_before) and variance.is_close_to(variance_before):
            break
    kept, variance = kept_before, variance_before
    dof = _degrees_of_freedom(problem, table, kept)
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    geometry, cov, scatter_arcsec = _result(problem, solution, prior)
    return Estimate(
        geometry=geometry,
        covariance=cov,
        state=solution.state,
        table=table,
        kept=kept,
        residual_px=residual_px,
        variance=variance,
        variance_factor=float(chi2_given / dof),
        alignment_scatter_arcsec=scatter_arcsec,
        iterations=iterations,
        termination=solution.termination,
    )


def _fitting(
    residual_px: Floats, table: StarTable, variance: CentroidVariance, options: CalibrationOptions
) -> Mask:
    """Return (n,) whether a star is no outlier, in an image that has enough of such."""
    length2 = squared_sigmas(residual_px, variance.of(table.covariance_px2))
    fits = length2 < options.outlier_sigma**2
    # The rotation of an image fits any one star, and two as good as any.
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= 3))


def _residuals(state: State, table: StarTable) -> Floats:
    return residuals_px(table, state.parameters, state.camera_from_icrf.as_matrix())


def _degrees_of_freedom(problem: Problem, table: StarTable, kept: Mask) -> int:
    """Residuals less unknowns; the unknowns of the hierarchical method count as data too."""
    images = len(np.unique(table.image[kept]))
    unknowns = len(problem.free) + (3 * images if problem.method == 'per_image' else 3)
    if problem.method == 'hierarchical':
        # Attitudes far better measured by the stars than by the tracker are free in effect.
        unknowns += 3 * images - 3
    dof = 2 * int(np.count_nonzero(kept)) - unknowns
    if dof <= 0:
        raise NotObservable('fewer residuals than unknowns')
    return dof


def estimate_variance(
    residual_px: Floats, covariance_px2: Floats, kept: Mask, freedom: float
) -> CentroidVariance:
    """
    Scale and floor that make the centroid covariances those of the residuals.

    The kept stars are ranked by their own variance and cut into groups; the median squared
    residual of a group, which outliers do not move, is its variance; scale and floor are the
    non-negative line through the groups.  ``freedom`` is the share of the residuals' degrees of
    freedom that the fit has left them.
    """
    own = 0.5 * (covariance_px2[kept, 0] + covariance_px2[kept, 2])
    squared = (residual_px[kept] ** 2).sum(axis=1)
    groups = int(np.clip(len(own) // _STARS_PER_GROUP, 1, 12))
    parts = np.array_split(np.argsort(own, kind='stable'), groups)
    mean_own = np.array([own[part].mean() for part in parts])
    # The median of a squared Rayleigh deviate is 2 ln 2 variances per axis.
    found = np.array([np.median(squared[part]) for part in parts]) / (2 * math.log(2.0) * freedom)
    if groups < 3 or mean_own[-1] < 2.0 * mean_own[0]:
        # Scale and floor cannot be told apart: a floor when there is an excess, else a scale.
        excess = float((found - mean_own).mean())
        if excess >= 0.0:
            return CentroidVariance(1.0, excess)
        return CentroidVariance(float(np.clip((found / mean_own).mean(), 0.1, 1.0)), 0.0)
    scale, floor_px2 = 1.0, 0.0
    for _ in range(5):
        weight = 1.0 / np.maximum(scale * mean_own + floor_px2, 1e-12)
        A = np.stack([mean_own, np.ones(groups)], axis=-1) * weight[:, None]
        (scale, floor_px2), _ = nnls(A, found * weight)
        scale = max(float(scale), 0.1)
    return CentroidVariance(scale, float(floor_px2))


def _minimise(
    problem: Problem, state: State, measurements: Measurements, loss_scale: float
) -> Solution[State]:
    """Levenberg-Marquardt with the method's own assembly of the normal equations."""

    def evaluate(at: State) -> NormalEquations:
        cost, blocks = normal_blocks(
            measurements, at.parameters, at.camera_from_icrf.as_matrix(), loss_scale
        )
        return _assemble(problem, at, cost, blocks)

    def move(at: State, shared: Floats, blocks: Floats) -> State:
        return _move(problem, at, shared, blocks)

    return levenberg_marquardt(state, evaluate, move)


def _assemble(problem: Problem, state: State, cost: float, blocks: Floats) -> NormalEquations:
    """Normal equations of the method from the (14, 14) matrices of the images."""
    free = problem.free
    f = len(free)
    if problem.method == 'single':
        total = blocks.sum(axis=0)
        shared = np.concatenate([free, np.arange(ROTATION.start, ROTATION.stop)])
        empty = np.empty((0, 3, f + 3)), np.empty((0, 3, 3)), np.empty((0, 3))
        return NormalEquations(
            cost, total[np.ix_(shared, shared)], total[shared, RESIDUAL], *empty
        )
    A = blocks[:, CAMERA, CAMERA].sum(axis=0)[np.ix_(free, free)]
    a = blocks[:, CAMERA, RESIDUAL].sum(axis=0)[free]
    B = blocks[:, ROTATION, CAMERA][:, :, free]
    C = blocks[:, ROTATION, ROTATION]
    c = blocks[:, ROTATION, RESIDUAL]
    if problem.method == 'per_image':
        # An image whose stars were all left out keeps its rotation: nothing pulls on it.
        empty_image = C[:, 0, 0] == 0
        C = np.where(empty_image[:, None, None], np.eye(3), C)
        return NormalEquations(cost, A, a, B, C, c)
    residual, J = _attitude_errors(problem, state)
    information = J.transpose(0, 2, 1) @ J
    gradient = np.einsum('mji,mj->mi', J, residual)
    A_full = np.zeros((f + 3, f + 3))
    A_full[:f, :f] = A
    A_full[f:, f:] = information.sum(axis=0)
    return NormalEquations(
        cost=cost + 0.5 * float((residual**2).sum()),
        A=A_full,
        a=np.concatenate([a, gradient.sum(axis=0)]),
        B=np.concatenate([B, -information], axis=2),
        C=C + information,
        c=c - gradient,
    )


def _attitude_errors(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """
    Whitened star tracker errors (m, 3), and their derivative (m, 3, 3) by the images' rotations.

    The derivative by the common alignment is the negative of it.
    """
    star_tracker_from_camera = state.camera_from_star_tracker.inv()
    error = (
        star_tracker_from_camera * state.camera_from_icrf * problem.star_tracker_from_icrf.inv()
    )
    eta = -error.as_rotvec()
    # d Log: the inverse Jacobian of SO(3) to first order, exact to eta^2 / 12 (1e-9 at 20 arcsec).
    half = 0.5 * _cross_matrix(eta)
    J = (np.eye(3) + half) @ star_tracker_from_camera.as_matrix()
    sigma = problem.star_tracker_sigma_rad
    return eta / sigma, J / sigma[:, None]


def _cross_matrix(v: Floats) -> Floats:
    """Matrices (m, 3, 3) with ``_cross_matrix(v) @ w = v x w``."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _move(problem: Problem, state: State, shared: Floats, blocks: Floats) -> State:
    """Take a step: parameters add, rotations turn (Eq. 11)."""
    f = len(problem.free)
    parameters = state.parameters.copy()
    parameters[problem.free] += shared[:f]
    alignment = state.camera_from_star_tracker
    if problem.method == 'per_image':
        return State(parameters, alignment, Rotation.from_rotvec(-blocks) * state.camera_from_icrf)
    turn = Rotation.from_rotvec(-shared[f:])
    alignment = turn * alignment
    if problem.method == 'single':
        return State(parameters, alignment, turn * state.camera_from_icrf)
    return State(parameters, alignment, Rotation.from_rotvec(-blocks) * state.camera_from_icrf)


def _result(
    problem: Problem, solution: Solution[State], prior: CameraGeometry
) -> tuple[CameraGeometry, Floats, float]:
    """Geometry, its (13, 13) covariance and the scatter of the images' alignments, arcsec."""
    state = solution.state
    shared, cross, within = covariance(solution.normal)
    m, f = len(cross), len(problem.free)
    estimated = np.concatenate([problem.free, [10, 11, 12]])
    full = np.zeros((13, 13))
    scatter_arcsec = 0.0
    alignment = state.camera_from_star_tracker
    if problem.method == 'per_image':
        used = solution.normal.B.any(axis=(1, 2))
        alignments = (state.camera_from_icrf * problem.star_tracker_from_icrf.inv())[used]
        tracker = np.diag(problem.star_tracker_sigma_rad**2)
        C = alignments[0].as_matrix()
        tracker = C @ tracker @ C.T
        weight = 1.0 / np.trace(within[used] + tracker, axis1=1, axis2=2)
        alignment = alignments.mean(weight)
        weight = weight / weight.sum()
        deviation = (alignments * alignment.inv()).as_rotvec()
        scatter_arcsec = float(np.sqrt(np.mean(deviation**2))) / ARCSECOND_RAD
        # The mean of the rotations is linear in theirs: theta_k = own noise_k - F_k * shared.
        mean_cross = np.einsum('m,mij->ij', weight, cross[used])
        own = np.linalg.inv(solution.normal.C[used])
        F = np.linalg.solve(shared, mean_cross.T).T
        mean = np.einsum('m,mij->ij', weight**2, own + tracker)
        mean += F @ shared @ F.T
        block = np.block(
            [
                [shared, mean_cross.T],
                [mean_cross, mean],
            ]
        )
    else:
        block = shared
        if problem.method == 'hierarchical' and m:
            errors, _ = _attitude_errors(problem, state)
            eta = errors * problem.star_tracker_sigma_rad
            scatter_arcsec = float(np.sqrt(np.mean(eta**2))) / ARCSECOND_RAD
    assert block.shape == (f + 3, f + 3)
    full[np.ix_(estimated, estimated)] = 0.5 * (block + block.T)
    camera = prior.camera.replace(
        **{PARAMETER_NAMES[i]: float(state.parameters[i]) for i in problem.free}
    )
    quaternion = alignment.inv().as_quat()
    # One of the two quaternions of a rotation, so that equal calibrations are equal numbers.
    quaternion = quaternion * math.copysign(1.0, quaternion[3])
    return CameraGeometry(camera, quaternion), full, scatter_arcsec
