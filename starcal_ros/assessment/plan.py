# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Which images to take next: those whose stars lower a sigma most.

Near the estimate the posterior is linear: an image at a candidate pointing adds the rows of its
stars, of its star-tracker attitude and of the prior of its shape, with its own unknowns
eliminated.  The image that lowers a variance most is chosen, then the next one
given it.  That needs no data, only where the stars are.

Amplitudes and variances stay those of the estimate, but for structure finer than the field that
the stars do not show: its bound falls as stars are added (`forecast`).  So a forecast draws
nothing at random, never rises with an image, and does not depend on the order of the images.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from starcal_ros.arrays import Floats, Mask
from starcal_ros.assessment.budget import mean_squares
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import Linearisation, star_rows, tracker_turns
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import Problem, State, whitened_attitude_errors
from starcal_ros.estimation.rates import Rates
from starcal_ros.estimation.search import problem_of, start_of
from starcal_ros.estimation.star_equations import arrange, star_table
from starcal_ros.estimation.unknowns import Assumptions, IMAGE_ROTATION, unknowns_of
from starcal_ros.records import Ensemble, StarObservations

MAP, LINE_OF_SIGHT = 'map', 'line_of_sight'
_GROUPS = 20  # of stars by magnitude
_ROUNDING = float(np.finfo(float).eps)  # held unknowns have no variance
_SHOWN = 4.0  # 2 log L of a variance that the stars show: two sigma
_AT_ONCE = 32  # candidates: their rows take some 10 MB


@dataclass(frozen=True)
class Target:
    """
    A sigma to lower: ``sqrt(tr(squares P) + constant) / unit``.

    ``squares`` (P, P) by the shared unknowns; ``name`` with the unit as suffix.
    """

    name: str
    squares: Floats
    constant: float
    unit: float

    def sigma(self, covariance: Floats) -> float:
        """Return the 1-sigma under a covariance (P, P) of the shared unknowns."""
        variance = max(float(np.einsum('ij,ji->', self.squares, covariance)), 0.0)
        return math.sqrt(variance + self.constant) / self.unit


def target(estimate: Estimate, name: str) -> Target:
    """
    Return the sigma of a name.

    ``line_of_sight``: of directions in the star tracker frame, RMS over the detector; ``map``: the
    same without the rotation common to the detector; or a camera parameter or alignment angle.

    Raises OptionError if nothing that is estimated has this name.
    """
    layout = estimate.linear.layout
    if name in (MAP, LINE_OF_SIGHT):
        (of_map, of_pointing), of_pixel = mean_squares(estimate)
        unresolved = of_pixel * estimate.pixel_sigma_px**2
        squares = of_map if name == MAP else of_pointing
        return Target(f'{name}_arcsec', squares, unresolved, ARCSECOND_RAD)
    if name not in layout.labels:
        allowed = ', '.join([LINE_OF_SIGHT, MAP, *layout.labels[: layout.places['field'].start]])
        raise OptionError(f'{name!r} is not estimated; a sigma to lower is one of: {allowed}')
    of_name = np.equal(layout.labels, name).astype(np.float64)
    return Target(name, np.diag(of_name), 0.0, 1.0)


def expected_noise_px2(estimate: Estimate, magnitude: Floats) -> Floats:
    """
    Return the variance (n,) per axis of centroids of stars of these magnitudes, as measured.

    From the observed stars in `_GROUPS` groups of neighbours in magnitude that have as much
    information each: bright stars are few and weigh most.
    """
    table = estimate.table
    order = np.argsort(table.magnitude)
    information = 1.0 / estimate.covariance_px2[order][:, [0, 2]].mean(axis=1)
    share = np.cumsum(information) / information.sum()
    group = np.minimum((share * _GROUPS).astype(np.int64), _GROUPS - 1)
    count = np.bincount(group, minlength=_GROUPS)
    some = count > 0
    middle = np.bincount(group, table.magnitude[order], _GROUPS)[some] / count[some]
    mean = np.bincount(group, information, _GROUPS)[some] / count[some]
    return np.asarray(np.exp(-np.interp(magnitude, middle, np.log(mean))))


@dataclass(frozen=True)
class Prospect:
    """
    Information that c candidate images add to an estimate.

    ``root`` (P, r) of the covariance of the shared unknowns; ``information`` (c, r, r) of each
    image in its columns: the covariance after images k, l is
    ``root (1 + information[k] + information[l])^-1 root'``.
    """

    root: Floats
    information: Floats

    def best(self, chosen: Sequence[int], allowed: Mask, squares: Floats) -> int:
        """Return which allowed candidate lowers a variance most, after those that are chosen."""
        before = np.eye(self.root.shape[1]) + self.information[list(chosen)].sum(axis=0)
        seen = self.root.T @ squares @ self.root
        variance = np.full(len(self.information), np.inf)
        for k in np.flatnonzero(allowed):
            variance[k] = _variance(before + self.information[k], seen)
        return int(np.argmin(variance))

    def variances(self, chosen: Sequence[int], squares: Floats) -> Floats:
        """Return the variance (n + 1,) now and after each of n chosen candidates."""
        none = np.eye(self.root.shape[1])
        added = np.cumsum(self.information[list(chosen)], axis=0)
        seen = self.root.T @ squares @ self.root
        return np.array([_variance(one, seen) for one in (none, *(none + one for one in added))])


def forecast(
    estimate: Estimate, wanted: Target, variances: Floats, stars: Sequence[int]
) -> Floats:
    """
    Return the sigma (n + 1,) to expect now and after each of n images.

    ``variances`` (n + 1,) are those of `Prospect.variances`, ``stars`` (n,) the stars of images.
    A variance of fine structure that the stars show stays; one that they do not is their bound on
    it, which falls as their number grows.
    """
    fine = [error for error in estimate.shared_errors if not error.of_star]
    hidden = sum(error.variance_px2 for error in fine if error.likelihood_ratio < _SHOWN)
    share = hidden / max(sum(error.variance_px2 for error in fine), 1e-300)
    added = np.concatenate([[0.0], np.cumsum(stars)])
    falls = 1.0 - share * added / (estimate.kept.sum() + added)
    return np.asarray(np.sqrt(variances.clip(0.0) + wanted.constant * falls) / wanted.unit)


def _variance(information: Floats, squares: Floats) -> float:
    return float(np.trace(cho_solve(cho_factor(information), squares)))


def prospect(
    estimate: Estimate, candidates: Sequence[StarObservations], options: CalibrationOptions
) -> Prospect:
    """
    Return what candidate images add.

    They hold the stars that an image would show, at the pixels of the calibrated camera, with the
    covariances to expect.  The velocity of the observer acts on them as on the images.
    """
    covariance = estimate.posterior.covariance
    size = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size).clip(1e-300))
    known = values > _ROUNDING * len(values)
    root = size[:, None] * vectors[:, known] * np.sqrt(values[known])
    information = np.zeros((len(candidates), root.shape[1], root.shape[1]))
    for first in range(0, len(candidates), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        information[part] = _information(estimate, candidates[part], options, root)
    return Prospect(root, information)


def _information(
    estimate: Estimate,
    candidates: Sequence[StarObservations],
    options: CalibrationOptions,
    root: Floats,
) -> Floats:
    """Return the information (c, r, r) of candidates in the columns of a root (P, r)."""
    problem, state = _as_estimated(estimate, candidates, options)
    camera = estimate.geometry.camera
    # The columns of what is in the list.
    velocity_m_s = float('velocity' in estimate.linear.layout)
    assumed = Assumptions(velocity_m_s, (0.0, 0.0), 0.0)
    at_rest = Rates(np.zeros((len(candidates), 3)), np.zeros((len(candidates), 3, 3)))
    layout = unknowns_of(problem, state, at_rest, (camera.width, camera.height), assumed)
    place = [estimate.linear.layout.labels.index(label) for label in layout.labels]
    table = star_table(candidates)
    measurements = arrange(table, np.ones(len(table), bool), table.covariance_px2)
    linear = Linearisation(problem, state, layout, measurements, table.measured_px)
    _, J = whitened_attitude_errors(problem, state)
    turning, turns = tracker_turns(layout)
    information = np.zeros((len(candidates), root.shape[1], root.shape[1]))
    for chunk, by_shared, by_own, _ in star_rows(linear):
        _, stars, b = by_own.shape
        # Of the star tracker, and of the prior of the shape.
        shared = np.pad(by_shared, ((0, 0), (0, b), (0, 0)))
        own = np.pad(by_own, ((0, 0), (0, b), (0, 0)))
        of_tracker, of_shape = np.split(np.arange(stars, stars + b), [IMAGE_ROTATION.stop])
        shared[:, of_tracker[:, None], turning] = -J[chunk.image] @ turns[chunk.image]
        own[:, of_tracker, IMAGE_ROTATION] = J[chunk.image]
        own[:, of_shape, layout.places['shape']] = np.diag(1.0 / estimate.posterior.shape_sigma_px)
        Q = np.linalg.qr(own)[0]
        left = (shared - Q @ (Q.transpose(0, 2, 1) @ shared)) @ root[place]
        information[chunk.image] = left.transpose(0, 2, 1) @ left
    return information


def _as_estimated(
    estimate: Estimate, candidates: Sequence[StarObservations], options: CalibrationOptions
) -> tuple[Problem, State]:
    """Return problem and state of candidates: the camera, and star trackers as the images have."""
    problem = problem_of(Ensemble(tuple(candidates)), estimate.geometry, options)
    sigma_rad = np.median(estimate.linear.problem.star_tracker_sigma_rad, axis=0)
    problem = dataclasses.replace(
        problem, star_tracker_sigma_rad=np.tile(sigma_rad, (len(candidates), 1))
    )
    found = estimate.linear.state
    state = start_of(problem, estimate.geometry, len(found.focal), bool(len(found.rate)))
    return problem, dataclasses.replace(state, focal=found.focal, rate=found.rate)
