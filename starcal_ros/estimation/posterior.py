# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Posterior of all unknowns given the data: mean and covariance, averaged over the amplitudes.

The estimator is linear at the minimum: weighted least squares with the priors of the unknowns.
Errors that observations share (`shared_errors`, `tracker_errors`) lower the weights to those that
give the same precision, and enter the covariance exactly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from scipy.linalg import solve
from scipy.sparse import csr_array

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.amplitudes import (
    Amplitudes,
    averaged_field,
    field_amplitudes,
    LEAST_PX,
    LogPrior,
    Shapes,
    shapes,
    ShapeSums,
    STARTS_PX,
)
from starcal_ros.estimation.centroid_variance import CentroidVariance
from starcal_ros.estimation.equations import (
    arrow,
    chain_columns,
    Linearisation,
    seen_by_stars,
    StarSums,
    tracker_turns,
    weighted_rows_by,
    without_images,
)
from starcal_ros.estimation.levenberg_marquardt import Equations, inverse, NotObservable
from starcal_ros.estimation.limits import FREE_FACTOR, NEGLIGIBLE, STEP_SIGMA
from starcal_ros.estimation.problem import whitened_attitude_errors
from starcal_ros.estimation.shared_errors import group_sums, SharedError, star_shares_px2
from starcal_ros.estimation.star_equations import StarTable
from starcal_ros.estimation.tracker_errors import AttitudeErrors, TrackerErrors
from starcal_ros.estimation.unknowns import CHANGE, IMAGE_ROTATION, Layout, Unknown


@dataclass(frozen=True)
class ErrorParts:
    """
    Covariance of the shared unknowns by its causes: ``root (1 + excess) root'``.

    Attributes
    ----------
    root : (P, r)
        Root of the covariance under the working weights, without that of `common_shape`.
    excess : (r, r)
        Covariance of the actual errors less that of the working weights.
    shared : mapping of (r, r)
        Whole variance of each error that observations share, and of the star trackers.
    """

    root: Floats
    excess: Floats
    shared: Mapping[str, Floats]


@dataclass(frozen=True)
class Posterior:
    """
    Posterior of P shared unknowns and of the b unknowns of each of m images.

    Attributes
    ----------
    mean : (P,)
    working : (P, P)
        Covariance under independent errors of the working weights, without the part of the shapes
        that all images share.
    equations : Equations
        From the stars and the star trackers, at these amplitudes of the shapes.
    estimated : (e,) int
        Shared unknowns that are estimated; the others are held.
    field, term : Amplitudes
        Octaves of the field, and the next term of the lens.
    shapes : Shapes
        Shapes of the images.
    last_octave : (s,), (s,)
        Posterior of the logarithm of the finest amplitude of the field, with weights.
    log_evidence : float
        Log evidence of the data given the priors, up to a constant.
    layout : Layout
    errors : ErrorParts or None
        None before `with_shared_errors`.
    """

    mean: Floats
    working: Floats
    equations: Equations
    estimated: Indices
    field: Amplitudes
    term: Amplitudes
    shapes: Shapes
    last_octave: tuple[Floats, Floats]
    log_evidence: float
    layout: Layout
    errors: ErrorParts | None = None

    @property
    def step_sigma(self) -> Floats:
        """Steps of the shared unknowns of the state, in their sigmas; zero if they are held."""
        in_state = self.layout.in_state
        sigma = np.sqrt(np.diag(self.covariance)[in_state])
        steps = np.divide(self.mean[in_state], sigma, out=np.zeros_like(sigma), where=sigma > 0)
        return np.asarray(steps)

    @functools.cached_property
    def covariance(self) -> Floats:
        """Covariance (P, P); under the errors that observations share, if they are known."""
        total = self.working + common_shape(self.layout, self.shapes.common_px2)
        if self.errors is None:
            return total
        return np.asarray(total + self.errors.root @ self.errors.excess @ self.errors.root.T)

    @property
    def resolved(self) -> float:
        """Number of shared unknowns that the data determine."""
        part = np.ix_(self.estimated, self.estimated)
        return float(np.einsum('ij,ji->', self.equations.information[part], self.working[part]))

    @property
    def of_images(self) -> Floats:
        """Mean (m, b) of the unknowns of the images."""
        return np.asarray(self.equations.own - self.equations.back @ self.mean)


def posterior(
    sums: StarSums,
    linear: Linearisation,
    before: Floats | float = STARTS_PX[0],
    near: Posterior | None = None,
) -> Posterior:
    """
    Return the posterior from sums at a state.

    Parameters
    ----------
    before : (s,) or float
        Amplitudes px of the shapes of the images to begin with.
    near : Posterior, optional
        At a state near this one: the search of amplitudes begins with its own.
    """
    layout = linear.layout
    before = np.broadcast_to(before, len(layout.shape))
    normal = arrow(sums, linear.problem, linear.state, layout)
    start = without_images(normal, layout, before)
    solver = _Solver(layout)
    base, field_px = solver.likely(start, near.field if near else None)
    none = Amplitudes(np.full(len(before), math.log(LEAST_PX)), 0.0)
    found, last = Shapes(before, none, None), start
    if len(sums.blocks) > 1:
        by_image = _shape_sums(sums, linear, solver, field_px)
        found = shapes(by_image, near.shapes.amplitudes if near else None)
        last = without_images(normal, layout, found.sigma_px)
    mean, covariance, last_octave, term, log_evidence = solver.solve(last, base)
    # The unknowns of the images, eliminated, and the prior of their amplitudes.
    log_evidence += 0.5 * float(np.linalg.slogdet(last.covariance)[1].sum())
    log_evidence += 0.5 * float((last.own * normal.c).sum())
    log_px = np.log(found.sigma_px)
    log_evidence -= len(normal.c) * float(log_px.sum())
    log_evidence += float(LogPrior().log_density(log_px).sum())
    return Posterior(
        mean=mean,
        working=covariance,
        equations=last,
        estimated=solver.estimated,
        field=base,
        term=term,
        shapes=found,
        last_octave=last_octave,
        log_evidence=log_evidence,
        layout=layout,
    )


def without_prior(
    sums: StarSums, linear: Linearisation, freed: Unknown, near: Posterior
) -> tuple[Floats, Floats, float]:
    """
    Return mean and variance (q,) of the unknowns of an entry without its prior, and log evidence.

    ``freed`` is the entry with the sigmas that are to hold in place of its prior.  The amplitudes
    are estimated again: field and shapes may hide that a prior is wrong.  A free trend and a free
    velocity would absorb errors of the lens, so the trend keeps its value of the posterior
    ``near`` with the prior, and its cost.  The variance is that of the working weights; infinite
    where stars show less than what is possible at all.
    """
    at_trend = linear.layout.trend_at
    trend, stated = near.mean[at_trend], linear.layout.prior_precision[at_trend]
    cost = 0.5 * float(
        (stated * trend**2 - np.log(stated * np.diag(near.working)[at_trend])).sum()
    )
    entries = []
    for entry in linear.layout.entries:
        if entry.name == freed.name:
            entry = freed
        elif entry.kind.cause == CHANGE and not entry.of_image:
            kept = near.mean[linear.layout.places[entry.name]]
            entry = dataclasses.replace(entry, sigma=entry.sigma / FREE_FACTOR, offset=-kept)
        entries.append(entry)
    wide = Layout(tuple(entries))
    linear = dataclasses.replace(linear, layout=wide)
    at = wide.of([freed.name])
    try:
        found = posterior(sums, linear)
    except (NotObservable, np.linalg.LinAlgError):  # its prior alone determines it
        return np.zeros(len(at)), np.full(len(at), np.inf), -np.inf
    precision, off = wide.prior_precision[at], wide.prior_offset[at]
    with np.errstate(divide='ignore', invalid='ignore'):
        shown = 1.0 / np.diag(found.working)[at] - precision
        seen = np.isfinite(shown) & (shown > precision)
        variance = np.where(seen, 1.0 / shown, np.inf)
        # The wide prior pulls a little: off + mean is the sum of both by their information.
        alone = (off + found.mean[at]) * (1.0 + precision * variance) - off
    return np.where(seen, alone, 0.0), variance, found.log_evidence - cost


class _Solver:
    """Solution of the shared unknowns: the field by its amplitudes, the others by their priors."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.precision = layout.prior_precision
        self.field = layout.field_at
        self.free = np.setdiff1d(np.flatnonzero(np.isfinite(self.precision)), self.field)
        self.estimated = np.concatenate([self.free, self.field])
        field = layout.field
        assert field.octave is not None and field.term is not None
        self.unit, self.octave, self.term = field.sigma, field.octave, field.term / field.sigma
        self.first = field.log_px

    def _of_field(self, arrow: Equations) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """
        Return information and gradient of the field in its unit, and the eliminated part.

        That is the covariance of all but the field, the field known, their gradient, and how they
        follow the field.
        """
        of_free = arrow.information[np.ix_(self.free, self.free)]
        free = inverse(of_free + np.diag(self.precision[self.free]))
        offset = self.precision[self.free] * self.layout.prior_offset[self.free]
        gradient = arrow.gradient[self.free] - offset
        cross = arrow.information[np.ix_(self.free, self.field)] * self.unit
        back = free @ cross
        own = arrow.information[np.ix_(self.field, self.field)] * np.outer(self.unit, self.unit)
        information = own - cross.T @ back
        left = arrow.gradient[self.field] * self.unit - back.T @ gradient
        return 0.5 * (information + information.T), left, free, gradient, back

    def likely(self, arrow: Equations, near: Amplitudes | None) -> tuple[Amplitudes, Floats]:
        """Return the amplitudes of the octaves of the field, and its coefficients (q,) at them."""
        information, gradient, *_ = self._of_field(arrow)
        amplitudes = field_amplitudes(information, gradient, self.octave, near, self.first)
        s = np.exp(amplitudes.log_px)[self.octave]
        scaled = information * np.outer(s, s)
        scaled[np.diag_indices(len(s))] += 1.0
        return amplitudes, self.unit * s * solve(scaled, s * gradient, assume_a='pos')

    def solve(
        self, arrow: Equations, amplitudes: Amplitudes
    ) -> tuple[Floats, Floats, tuple[Floats, Floats], Amplitudes, float]:
        """Return mean (P,), covariance (P, P), last octave, lens term, and log evidence."""
        count = self.layout.count
        mean, covariance = np.zeros(count), np.zeros((count, count))
        information, left, free, gradient, back = self._of_field(arrow)
        field = averaged_field(information, left, self.octave, amplitudes, self.term, self.first)
        mean[self.field] = self.unit * field.mean
        mean[self.free] = free @ gradient - back @ field.mean
        to_free = -back @ field.covariance
        covariance[np.ix_(self.field, self.field)] = field.covariance * np.outer(
            self.unit, self.unit
        )
        covariance[np.ix_(self.free, self.field)] = to_free * self.unit
        covariance[np.ix_(self.field, self.free)] = (to_free * self.unit).T
        covariance[np.ix_(self.free, self.free)] = free - to_free @ back.T
        precision, offset = self.precision[self.free], self.layout.prior_offset[self.free]
        stated = precision > 0
        log_evidence = field.log_evidence + 0.5 * float(
            np.linalg.slogdet(free)[1]
            + gradient @ free @ gradient
            + (np.log(precision[stated]) - precision[stated] * offset[stated] ** 2).sum()
        )
        return mean, covariance, (field.log_px, field.weight), field.term, log_evidence


def _shape_sums(
    sums: StarSums, linear: Linearisation, solver: _Solver, field_px: Floats
) -> ShapeSums:
    """
    Return the sums of each image for its shape, the field known, its other unknowns eliminated.

    The images share the field; each has stars in other parts of it.  A trend is a change of the
    images as well, and correlated: its common part has to be known here.
    """
    layout = linear.layout
    blocks = sums.blocks.copy()
    blocks[:, :-1, -1] -= (field_px @ sums.field_cross)[:, :-1]
    _, own, rotation = chain_columns(layout)
    size = np.einsum('mii->mi', blocks[:, rotation, rotation]).max(axis=1)
    columns = np.arange(blocks.shape[1])
    others = columns[rotation]
    weak = np.where(size > 0, 1e-9 * size, 1.0)[:, None] * np.ones(3)
    for entry in layout.of_image:
        if entry is not layout.shape:
            others = np.concatenate([others, columns[own][layout.places[entry.name]]])
            weak = np.concatenate([weak, np.tile(entry.sigma**-2.0, (len(weak), 1))], axis=1)
    C = blocks[:, others[:, None], others] + weak[:, :, None] * np.eye(len(others))
    back = np.linalg.solve(C, blocks[:, others])
    left = blocks - blocks[:, others].transpose(0, 2, 1) @ back
    shape, total = columns[own][layout.shape_at], left.sum(axis=0)
    at = seen_by_stars(layout)  # the first columns
    precision, offset = solver.precision[at], layout.prior_offset[at]
    free = np.flatnonzero(np.isfinite(precision) & ~np.isin(at, layout.trend_at))
    return ShapeSums(
        left[:, shape[:, None], shape],
        left[:, shape, -1],
        left[:, shape[:, None], free],
        total[np.ix_(free, free)] + np.diag(precision[free]),
        total[free, -1] - precision[free] * offset[free],
        linear.problem.time_s,
    )


def common_shape(layout: Layout, common_px2: Floats) -> Floats:
    """Return the covariance (P, P) of the shapes that all images share, by the camera."""
    camera, shapes = layout.places['camera'], layout.shape.camera
    assert shapes is not None
    free = np.isfinite(layout.prior_precision[camera])
    modes = shapes[0] * free[:, None]
    covariance = np.zeros((layout.count, layout.count))
    covariance[camera, camera] = (modes * common_px2) @ modes.T
    return covariance


TRACKER_NOISE, TRACKER_SLOW = 'star tracker noise', 'star tracker slow error'


@dataclass(frozen=True)
class Weighting:
    """
    Conclusions from the residuals of a round: the weights of the next one.

    Attributes
    ----------
    table : StarTable
        Its n observations are weighted.
    from_sky : (n, 2, 2)
        Rotation of a displacement fixed to the star into pixel axes.
    variance : CentroidVariance
        How the centroid covariances are corrected.
    errors : tuple of SharedError
    kept : (n,) bool
        Observations that are used.
    attitudes : AttitudeErrors or None
        None before the first round.
    """

    table: StarTable
    from_sky: Floats
    variance: CentroidVariance
    errors: tuple[SharedError, ...]
    kept: Mask
    attitudes: AttitudeErrors | None

    @functools.cached_property
    def covariance_px2(self) -> Floats:
        """
        Covariances (n, 3) of the observations: noise, and errors that a star alone has.

        What a star has beyond others of its brightness adds to both axes.  What it lacks takes the
        same share of both: a smear is narrower than the mean of its axes.
        """
        covariance_px2 = self.variance.of(self.table.covariance_px2, self.table.magnitude)
        beyond_px2 = np.broadcast_to(star_shares_px2(self.errors)[1], len(self.table))
        mean_px2 = 0.5 * (covariance_px2[:, 0] + covariance_px2[:, 2])
        share = 1.0 + np.minimum(beyond_px2, 0.0) / mean_px2
        more_px2 = np.outer(np.maximum(beyond_px2, 0.0), [1.0, 0.0, 1.0])
        return np.asarray(covariance_px2 * share[:, None] + more_px2)

    @functools.cached_property
    def variance_px2(self) -> Floats:
        """Variance (n,) of the observations per axis."""
        return np.asarray(self.covariance_px2[:, [0, 2]].mean(axis=1))

    @functools.cached_property
    def inflation_px2(self) -> Floats:
        """
        Variance (n,) by which the weights are lower for errors that images share.

        With it, k images of a star weigh as the mean of theirs does.
        """
        star = self.table.star
        sightings = np.bincount(star, self.kept, int(star.max()) + 1)[star]
        return np.asarray(np.maximum(sightings - 1.0, 0.0) * star_shares_px2(self.errors)[0])

    @property
    def working_px2(self) -> Floats:
        """Covariances (n, 3) whose inverses are the weights."""
        return self.covariance_px2 + np.outer(self.inflation_px2, [1.0, 0.0, 1.0])


def still_to_move(
    found: Posterior, before: Posterior, moved: Floats | None
) -> tuple[Floats, Floats]:
    """
    Return how far a round has moved a posterior, and how far it has still to go (n,), (n,).

    By the steps of the unknowns of the state, and the variances of these and of the field, each
    over the largest that may be left: 1 is settled.  ``moved`` is that of the round before.  Of
    changes that fall by a factor q, those to come are ``q / (1 - q)`` of the last (Hairer & Wanner
    1996, IV.8); q is taken to be a half at most.

    The weights themselves need not settle: a star at the limit of outliers may come and go for
    ever, and the variance of what no star shows may creep to zero.
    """
    now, then = (
        np.append(np.diag(C)[one.layout.in_state], np.trace(C[np.ix_(field, field)]))
        for one in (found, before)
        for C, field in [(one.covariance, one.layout.field_at)]
    )
    known = (now > 0) & (then > 0)
    grown = np.log(now[known] / then[known]) / math.log1p(NEGLIGIBLE)
    last = np.abs(np.concatenate([found.step_sigma / STEP_SIGMA, grown]))
    falls = np.full_like(last, 0.5)
    if moved is not None and moved.shape == last.shape:
        np.divide(last, moved, out=falls, where=moved > 2.0 * last)
    return last, last * falls / (1.0 - falls)


def with_shared_errors(
    found: Posterior,
    sums: StarSums,
    linear: Linearisation,
    weights: Weighting,
    trackers: Sequence[TrackerErrors],
    negligible: float = NEGLIGIBLE,
) -> Posterior:
    """
    Return the posterior with the covariance under the errors that observations share.

    ``negligible``: information on a mode of the field times its variance, below which its prior
    holds it.
    """
    layout = linear.layout
    root, held = _root(found.working, found.estimated, sums, layout, negligible)
    excess, shared = _of_observations(found, linear, weights, root)
    of_attitudes, by_tracker = _of_attitudes(found, linear, trackers, root)
    excess += of_attitudes
    none = (0, held.shape[1])  # errors of the modes that priors hold
    return dataclasses.replace(
        found,
        errors=ErrorParts(
            np.concatenate([root, held], axis=1),
            np.pad(excess, none),
            {name: np.pad(one, none) for name, one in {**shared, **by_tracker}.items()},
        ),
    )


def _root(
    covariance: Floats, estimated: Indices, sums: StarSums, layout: Layout, negligible: float
) -> tuple[Floats, Floats]:
    """
    Return L (P, r) and M (P, h), where ``L L' + M M'`` is a covariance.

    M has the modes of the field that priors hold: errors of the observations move no mode that
    the observations do not determine.
    """
    field = layout.field_at
    others = np.setdiff1d(estimated, field)
    values, vectors = np.linalg.eigh(covariance[np.ix_(field, field)])
    values, vectors = values[values > 0], vectors[:, values > 0]
    size = np.sqrt(values)
    modes = np.zeros((layout.count, len(values)))
    modes[field] = vectors * size
    # The others follow the modes of the field, and have a part of their own.
    modes[others] = covariance[np.ix_(others, field)] @ vectors / size
    left = covariance[np.ix_(others, others)] - modes[others] @ modes[others].T
    size = np.sqrt(np.diag(left).clip(1e-300))
    own_values, own_vectors = np.linalg.eigh(left / np.outer(size, size))
    own = np.zeros((layout.count, len(others)))
    own[others] = size[:, None] * own_vectors * np.sqrt(own_values.clip(0.0))
    shown = np.einsum('im,ij,jm->m', vectors, sums.field_information, vectors, optimize=True)
    moved = values * shown > negligible
    return np.concatenate([own, modes[:, moved]], axis=1), modes[:, ~moved]


def _of_observations(
    found: Posterior, linear: Linearisation, weights: Weighting, root: Floats
) -> tuple[Floats, dict[str, Floats]]:
    """
    Return ``L' X' W (V - 1/W) W X L`` (r, r) of the observations, and the errors that they share.

    The images are eliminated.  Each error is the whole variance (r, r) by it.
    """
    rows = weighted_rows_by(linear, root, -found.equations.back @ root)
    whole, own = group_sums(
        weights.errors,
        weights.variance_px2,
        weights.inflation_px2,
        weights.from_sky,
        ((chunk.row, Y) for chunk, Y in rows),  # stars of no weight add nothing
        root.shape[1],
    )
    return sum(whole.values(), -own), whole


def _of_attitudes(
    found: Posterior, linear: Linearisation, trackers: Sequence[TrackerErrors], root: Floats
) -> tuple[Floats, dict[str, Floats]]:
    """Return the same (r, r) of the star-tracker attitudes, by noise and slow errors."""
    _, J = whitened_attitude_errors(linear.problem, linear.state)
    at, turns = tracker_turns(linear.layout)
    rows = J @ (-(turns @ root[at]) - found.equations.back[:, IMAGE_ROTATION] @ root)
    r = root.shape[1]
    working, noise, slow = np.zeros((3, r, r))
    sigma_rad = linear.problem.star_tracker_sigma_rad
    for tracker in trackers:
        group, images = tracker.group, tracker.images
        # An image that was a misfit a round ago has no weight: its working sigma is infinite.
        to_working2 = (tracker.sigma_rad / sigma_rad[images, tracker.axes[0]].min()) ** 2
        shared = tracker.covariance - tracker.independent * np.eye(len(tracker.covariance))
        member = csr_array((np.ones(len(group)), (group, np.arange(len(group)))))
        for axis in tracker.axes:
            part = rows[images, axis]
            square = part.T @ part
            working += square
            noise += to_working2 * tracker.independent * square
            summed = member @ part
            slow += to_working2 * summed.T @ shared @ summed
    return noise + slow - working, {TRACKER_NOISE: noise, TRACKER_SLOW: slow}
