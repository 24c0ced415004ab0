# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Variances and misfits: the conclusions from the residuals of a search."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from starcal_ros.arrays import Floats, Mask
from starcal_ros.estimation.options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.least_squares.levenberg_marquardt import NotObservable
from starcal_ros.least_squares.linear_terms import LinearTerms
from starcal_ros.least_squares.normal_equations import (
    arrange,
    Measurements,
    residuals_px,
    squared_sigmas,
    StarTable,
)
from starcal_ros.methods.assembly import score_of
from starcal_ros.methods.image_unknowns import attitudes_of_stars_alone, shape_unknowns
from starcal_ros.methods.problem import (
    image_blocks,
    image_field,
    image_parameters,
    Problem,
    State,
)
from starcal_ros.model_errors.image_variation import image_variation, ImageVariation
from starcal_ros.model_errors.repeated_pointings import pointing_groups, repetition
from starcal_ros.model_errors.variance_components import (
    CentroidVariance,
    estimate_star_tracker_sigma,
    estimate_variance,
)

FEWEST_STARS = 3  # of an image: its rotation fits any one star, and two as good as any
_FEWEST_SIGHTINGS = 3  # of a star, from which it can be told from its images
_STAR_CHANCE = 1e-7  # that a good star is dropped for the sum of its residuals


@dataclass(frozen=True)
class Verdict:
    """What the residuals say: the variances, and what is left out."""

    variance: CentroidVariance
    tracker_sigma_rad: Floats  # (3,)
    misfit: Mask  # (m,)
    kept: Mask  # (n,)
    repetition: Floats  # (n,) factor on the covariances
    variation: ImageVariation

    def covariance_px2(self, table: StarTable) -> Floats:
        """Return the centroid covariances (n, 3) that the search weights with."""
        return self.variance.of(table.covariance_px2, table.magnitude) * self.repetition[:, None]

    def agrees_with(self, other: Verdict) -> bool:
        """Whether a search with the one would end where a search with the other does."""
        return (
            np.array_equal(self.kept, other.kept)
            and np.array_equal(self.misfit, other.misfit)
            and self.variance.is_close_to(other.variance)
            and np.allclose(self.repetition, other.repetition, rtol=0.02)
            and np.allclose(self.tracker_sigma_rad, other.tracker_sigma_rad, rtol=0.02)
            and self.variation.is_close_to(other.variation)
        )


@dataclass(frozen=True)
class Weighted:
    """The stars as a verdict weights them, and their `image_blocks` at one state, if known."""

    measurements: Measurements
    state: State | None = None
    image_blocks: tuple[float, Floats] | None = None

    def at(self, state: State) -> tuple[float, Floats] | None:
        """Return the `image_blocks` at a state, if known."""
        return self.image_blocks if state is self.state else None


def arranged(table: StarTable, verdict: Verdict) -> Measurements:
    """Lay out the stars that a verdict keeps, with its covariances."""
    return arrange(table, verdict.kept, verdict.covariance_px2(table))


def judge_residuals(
    problem: Problem,
    state: State,
    blocks: Floats,
    terms: LinearTerms | None,
    table: StarTable,
    before: Verdict,
    given_rad: Floats,
    options: CalibrationOptions,
) -> tuple[Verdict, Weighted]:
    """
    Variances and misfits from the residuals at a state that the verdict before has led to.

    With the stars as the verdict weights them, which a search with it needs.
    """
    residual_px = all_residuals_px(problem, state, table)
    variance, tracker_sigma_rad = CentroidVariance(1.0, 0.0), given_rad
    if options.variance_components:
        freedom = free_share(problem, state, blocks, terms, before.kept, before.tracker_sigma_rad)
        variance = estimate_variance(
            residual_px, table.covariance_px2, table.magnitude, before.kept, freedom
        )
    kept = _fitting(residual_px, table, variance, options)
    groups = pointing_groups(state.camera_from_icrf, float(state.parameters[0]))
    repeated = repetition(table, kept, residual_px, groups)
    del residual_px
    misfit: Mask = np.zeros(table.image_count, bool)
    covariance_px2 = variance.of(table.covariance_px2, table.magnitude) * repeated[:, None]
    measurements = arrange(table, kept, covariance_px2)
    variation = ImageVariation()
    # By the stars that fit: one that does not turns an image of few by more than the tracker.
    cost, blocks = image_blocks(problem, state, measurements)
    # One rotation for all has no attitude of an image to judge.
    if problem.method != 'single':
        eta_rad, covariance_rad2, seen = attitudes_of_stars_alone(problem, state, blocks)
        fitted = state.alignment_count // 3  # means of the attitudes, and slope
        found_rad, misfit = estimate_star_tracker_sigma(
            eta_rad,
            covariance_rad2,
            seen,
            given_rad,
            problem.star_tracker,
            fitted,
            tracker_sigma_is_given(options),
        )
        if options.variance_components:
            tracker_sigma_rad = found_rad
            variation = image_variation(blocks, state.shapes)
    verdict = Verdict(variance, tracker_sigma_rad, misfit, kept, repeated, variation)
    return verdict, Weighted(measurements, state, (cost, blocks))


def _fitting(
    residual_px: Floats, table: StarTable, variance: CentroidVariance, options: CalibrationOptions
) -> Mask:
    """
    Return (n,) which stars are used.

    Not an outlier; not a star that is one in most of its images, or whose residuals together are
    too large (a wrong catalog place, a planet); and in an image that has enough of the others.
    """
    length2 = squared_sigmas(residual_px, variance.of(table.covariance_px2, table.magnitude))
    fits = length2 < options.outlier_sigma**2
    star = table.star
    sightings = np.bincount(star)
    misses = np.bincount(star, ~fits)
    summed = np.bincount(star, np.where(fits, length2, 0.0))
    bad_star = (2 * misses > sightings) | (summed > chdtri(2 * sightings, _STAR_CHANCE))
    fits &= ~(bad_star & (sightings >= _FEWEST_SIGHTINGS))[star]
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= FEWEST_STARS))


def dropped_stars(table: StarTable, kept: Mask) -> NDArray[np.int64]:
    """Catalog stars that were seen often enough to be told apart, and left out of all images."""
    catalog_id, star = np.unique(table.catalog_id, return_inverse=True)
    sightings, uses = np.bincount(star), np.bincount(star, kept)
    return np.asarray(catalog_id[(sightings >= _FEWEST_SIGHTINGS) & (uses == 0)])


def all_residuals_px(problem: Problem, state: State, table: StarTable) -> Floats:
    """Measured minus predicted pixels (n, 2) of all stars at a state."""
    rotations = state.camera_from_icrf.as_matrix()
    return residuals_px(
        table,
        problem.model,
        image_parameters(problem, state),
        rotations,
        image_field(problem, state),
    )


def free_share(
    problem: Problem,
    state: State,
    blocks: Floats,
    terms: LinearTerms | None,
    kept: Mask,
    tracker_sigma_rad: Floats,
) -> float:
    """
    Share of the residuals' degrees of freedom that the fit leaves.

    An attitude that the star tracker holds costs less than three: with P the covariance from the
    stars and T the star tracker's, trace(T (T + P)^-1).  So does a mode of the field that its
    prior holds: one less its posterior variance; and the shape of an image.
    """
    unknowns = float(len(problem.free) + len(state.focal) + len(state.rate) + len(state.mountings))
    unknowns += shape_unknowns(problem, state, blocks)
    if terms is not None:
        without = dataclasses.replace(problem, field_prior=None)
        shown = score_of(without, state, blocks, None, terms).information
        unknowns += len(shown) - float(np.trace(np.linalg.inv(shown + np.eye(len(shown)))))
    if problem.method == 'single':
        unknowns += 3
    else:
        _, P, seen = attitudes_of_stars_alone(problem, state, blocks)
        if problem.method == 'per_image':
            unknowns += 3 * int(np.count_nonzero(seen))
        else:
            T = np.diag(tracker_sigma_rad**2)
            total = T + P[seen]
            # numpy 1 reads a single matrix beside a stack of them as a stack of vectors.
            held = np.linalg.solve(total, np.broadcast_to(T, total.shape))
            unknowns += float(np.trace(held, axis1=1, axis2=2).sum())
    share = 1.0 - unknowns / (2 * max(int(np.count_nonzero(kept)), 1))
    if share <= 0:
        raise NotObservable('fewer residuals than unknowns')
    return share
