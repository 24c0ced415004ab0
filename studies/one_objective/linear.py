# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Posterior of the linear unknowns, with the amplitudes of their priors by one marginal likelihood.

Each group of unknowns with an unknown prior sigma is a `Component`: an octave of the field, the
next term of the lens, a shape of the images.  In units of that sigma its unknowns g have unit
priors, and with the normal equations ``S`` of all shared unknowns, the images eliminated by their
own ``C``, the log marginal likelihood of the logarithms ``theta`` of the sigmas is::

    l = -1/2 log |S| - 1/2 sum log |C| + 1/2 mean' S mean + 1/2 sum c' C^-1 c + log prior

Its derivative by the amplitude of a group is the sum of ``g^2 + var(g) - 1``: zero where the
unknowns are as large as their prior.  The expected information is ``2 sum (1 - var)^2``.  Scoring
begins from above: amplitudes that are too large fall to what is there, or to nothing, where the
derivative vanishes.  Each evaluation is linear in the number of images and free of stars.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

from starcal_ros.arrays import Floats
from starcal_ros.estimation.amplitudes import (
    Amplitudes,
    interval_factor,
    LARGEST_FIELD_PX,
    LARGEST_SHAPE_PX,
    LOG_CENTRE,
    LOG_SIGMA,
    OCTAVE_SIGMA,
    OCTAVE_STEP,
    Shapes,
)
from starcal_ros.estimation.equations import arrow, eliminated, Linearisation, StarSums
from starcal_ros.estimation.levenberg_marquardt import NormalEquations, NotObservable
from starcal_ros.estimation.posterior import _shape_sums, _Solver, Posterior
from starcal_ros.estimation.unknowns import Layout

_RATIO = math.exp(-0.3)  # of octaves at the start, so that all of them are above
_MOST_STEPS = 12
_LARGEST_STEP = 2.0  # factor of e^2 in an amplitude
_SHARES = (1.0, 0.4, 0.16, 0.06)  # of a step, until the posterior rises
_SETTLED = 1e-2  # change of the log posterior that moves no sigma by a thousandth
# Shifts of the logarithm of an amplitude over which results are averaged: below the first, an
# amplitude of nothing has no effect.
_SHIFTS = np.array(
    [-8.0, -4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.5]
)
_NO_WEIGHT = 10.0  # log weight below the maximum


@dataclass(frozen=True)
class Component:
    """Amplitude of a group: start from above, largest value, and its logarithm's prior, px."""

    name: str
    start_px: float
    largest_px: float
    mean: float = LOG_CENTRE
    sigma: float = LOG_SIGMA


def components_of(layout: Layout) -> list[Component]:
    """
    Return the components: the octaves of the field, the next term of the lens, the shapes.

    An octave is known by its ratio to the one before.
    """
    assert layout.field.octave is not None
    count = int(layout.field.octave.max()) + 1
    mean, sigma = layout.field.log_px
    found = [Component('field', 2e-2, LARGEST_FIELD_PX, mean, sigma)]
    for k in range(1, count):
        found.append(Component(f'octave {k}', _RATIO, math.inf, OCTAVE_STEP, OCTAVE_SIGMA))
    found.append(Component('term', 3e-3, LARGEST_FIELD_PX))
    found += [Component(name, 1e-2, LARGEST_SHAPE_PX) for name in layout.shape.labels]
    return found


@dataclass(frozen=True)
class Point:
    """The log posterior at amplitudes, its slope (k,) and expected information (k, k)."""

    theta: Floats
    value: float
    slope: Floats
    information: Floats


@dataclass(frozen=True)
class _Reduced:
    """
    Equations of q shared unknowns in units of their priors, the images eliminated.

    ``value`` is the log posterior; ``c`` (q,) has the units; ``lower`` the Cholesky factor of
    S, ``half`` its inverse by the gradient; shapes follow by ``follow`` (m, s, q + 1), the last
    column by themselves, with the covariance ``own`` (m, s, s).
    """

    value: float
    c: Floats
    lower: Floats
    half: Floats
    follow: Floats
    own: Floats


class LinearModel:
    """Normal equations in units of the priors."""

    def __init__(self, normal: NormalEquations, layout: Layout) -> None:
        self.layout, self.components = layout, components_of(layout)
        field, P = layout.field_at, layout.count
        precision = layout.prior_precision
        free = np.setdiff1d(np.flatnonzero(np.isfinite(precision)), field)
        entry = layout.field
        assert entry.octave is not None and entry.term is not None
        f, q = len(free), len(free) + len(field) + 1
        self.unknowns = np.zeros((P, q))
        self.unknowns[free, np.arange(f)] = 1.0
        self.unknowns[field, np.arange(f, q - 1)] = entry.sigma
        self.unknowns[field, q - 1] = entry.term
        octaves = int(entry.octave.max()) + 1
        # The component of each unknown: -1 has a prior that is known.
        self.of = np.concatenate([np.full(f, -1), entry.octave, [octaves]])
        self.octaves = octaves
        self.prior = np.where(self.of < 0, 0.0, 1.0)
        self.prior[:f] = precision[free]
        A = self.unknowns.T @ normal.A @ self.unknowns
        a = self.unknowns.T @ normal.a
        a[:f] -= precision[free] * layout.prior_offset[free]
        # Units in which the known part of S is near one.
        self.unit = np.ones(q)
        self.unit[:f] = 1.0 / np.sqrt(np.diag(A)[:f] + precision[free])
        self.A, self.a = A * np.outer(self.unit, self.unit), a * self.unit
        self.prior[:f] *= self.unit[:f] ** 2
        self.shapes = np.arange(normal.C.shape[1])[layout.shape_at]
        own = layout.image_precision(1.0)
        own[self.shapes] = 0.0
        C = normal.C + np.diag(own)
        image_unit = 1.0 / np.sqrt(np.maximum(np.einsum('mii->mi', C), 1e-300))
        image_unit[:, self.shapes] = 1.0
        self.C = C * image_unit[:, :, None] * image_unit[:, None, :]
        B = (normal.B @ self.unknowns) * self.unit * image_unit[:, :, None]
        self.right = np.concatenate([B, (normal.c * image_unit)[:, :, None]], axis=2)
        self.prior_mean = np.array([one.mean for one in self.components])
        self.prior_sigma = np.array([one.sigma for one in self.components])
        self.largest = np.log([one.largest_px for one in self.components])
        # Logarithms of the amplitudes of the groups by theta: octaves are a chain.
        self.form = np.eye(len(self.components))
        self.form[:octaves, :octaves] = np.tri(octaves)
        self._images: tuple[bytes, tuple[Floats, ...]] = (b'', ())

    def start(self) -> Floats:
        """Return amplitudes from above."""
        return np.log([one.start_px for one in self.components])

    def _of_images(self, sigma_px: Floats) -> tuple[Floats, ...]:
        """Return the reduced equations, log determinant and factors of images."""
        if self._images[0] == sigma_px.tobytes():
            return self._images[1]
        s = self.shapes
        scale = np.ones(self.C.shape[1])
        scale[s] = sigma_px
        C = self.C * np.outer(scale, scale)
        C[:, s, s] += 1.0
        try:
            lower = np.linalg.inv(np.linalg.cholesky(C))
        except np.linalg.LinAlgError as error:
            raise NotObservable('the rotation of an image is not determined') from error
        whitened = lower @ (self.right * scale[:, None])
        flat = whitened.reshape(-1, whitened.shape[2])
        hidden = flat.T @ flat
        log_det = -2.0 * float(np.log(np.einsum('mii->mi', lower)).sum())
        # Shapes follow the shared unknowns by this; their own covariances.
        follow = lower.transpose(0, 2, 1)[:, s] @ whitened
        own = lower.transpose(0, 2, 1)[:, s] @ lower[:, :, s]
        self._images = sigma_px.tobytes(), (hidden, np.array(log_det), follow, own)
        return self._images[1]

    def _reduced(self, theta: Floats) -> _Reduced:
        """Return the equations of the shared unknowns in units of their priors, and l."""
        log_px, octaves = self.form @ theta, self.octaves
        hidden, log_det, follow, own = self._of_images(np.exp(log_px[octaves + 1 :]))
        c = np.where(self.of < 0, 1.0, np.exp(log_px[self.of]))
        S = (self.A - hidden[:-1, :-1]) * np.outer(c, c) + np.diag(self.prior)
        lower, failed = dpotrf(S, lower=True, clean=True)
        if failed:
            raise NotObservable('the unknowns cannot be separated')
        half = solve_triangular(lower, (self.a - hidden[:-1, -1]) * c, lower=True)
        off = (theta - self.prior_mean) / self.prior_sigma
        value = 0.5 * float(half @ half + hidden[-1, -1] - log_det - off @ off)
        value -= float(np.log(np.diag(lower)).sum())
        return _Reduced(value, c, lower, half, follow, own)

    def at(self, theta: Floats) -> Point:
        """Return the log posterior at amplitudes, with its slope and information."""
        reduced = self._reduced(theta)
        c = reduced.c
        below, _ = dpotri(reduced.lower, lower=True)
        covariance = below + below.T
        covariance[np.diag_indices(len(c))] *= 0.5
        mean = solve_triangular(reduced.lower, reduced.half, lower=True, trans='T')
        by_prior = (self.prior_mean - theta) / self.prior_sigma**2
        slope, fisher = self._scores(c, mean, covariance, reduced.follow, reduced.own)
        return Point(
            theta,
            reduced.value,
            by_prior + self.form.T @ slope,
            np.diag(self.prior_sigma**-2.0) + self.form.T @ fisher @ self.form,
        )

    def _scores(
        self, c: Floats, mean: Floats, covariance: Floats, follow: Floats, own: Floats
    ) -> tuple[Floats, Floats]:
        """Return slope (k,) and expected information (k, k) of the logarithms of amplitudes."""
        k, s = self.octaves + 1, len(self.shapes)
        member = np.equal.outer(np.arange(k), self.of).astype(np.float64)
        shown = np.eye(len(mean)) - covariance
        slope, fisher = np.zeros(k + s), np.zeros((k + s, k + s))
        slope[:k] = member @ (mean**2 - np.diag(shown))
        fisher[:k, :k] = 2.0 * member @ shown**2 @ member.T
        by_shared = follow[:, :, :-1] * c
        shape = follow[:, :, -1] - by_shared @ mean
        m, q = len(by_shared), len(mean)
        moved = (by_shared.reshape(m * s, q) @ covariance).reshape(m, s, q)
        own_shown = np.eye(s) - own - moved @ by_shared.transpose(0, 2, 1)
        slope[k:] = (shape**2 - np.einsum('mii->mi', own_shown)).sum(axis=0)
        fisher[k:, k:] = 2.0 * (own_shown**2).sum(axis=0)
        return slope, fisher

    def best(self, theta: Floats) -> Point:
        """Return the maximum of the log posterior that scoring reaches from amplitudes."""
        point = self.at(np.minimum(theta, self.largest))
        for _ in range(_MOST_STEPS):
            step = np.linalg.solve(point.information, point.slope)
            step *= _LARGEST_STEP / max(_LARGEST_STEP, float(np.abs(step).max()))
            before = point.value
            for share in _SHARES:
                trial = self.at(np.minimum(point.theta + share * step, self.largest))
                if trial.value > point.value - 1e-9:
                    point = trial
                    break
            if point.value - before < _SETTLED:
                break
        return point

    def wide_shapes(self, best: Point) -> Floats:
        """
        Return amplitudes with those of the shapes that represent their posterior.

        Errors of an uncertain sigma have long tails: that of the same 2-sigma interval, over a
        common factor of the shapes.
        """
        way = np.arange(len(best.theta)) > self.octaves
        room = float((self.largest - best.theta)[way].min())
        found = {0.0: best.value}
        for shifts in (_SHIFTS[_SHIFTS > 0], _SHIFTS[_SHIFTS < 0][::-1]):
            for shift in shifts[shifts <= room]:
                try:
                    value = self._reduced(best.theta + shift * way).value
                except NotObservable:
                    break
                found[float(shift)] = value
                if value < best.value - _NO_WEIGHT:
                    break
        shift = np.array(sorted(found))
        log_weight = np.array([found[one] for one in shift])
        weight = np.exp(log_weight - log_weight.max())
        weight *= np.gradient(shift) if len(shift) > 1 else 1.0
        factor = interval_factor(np.exp(shift), weight)
        return np.asarray(np.minimum(best.theta + math.log(factor) * way, self.largest))


def linear_posterior(
    sums: StarSums, linear: Linearisation, near: Floats | None
) -> tuple[Posterior, Floats]:
    """
    Return the posterior from sums at a state, and the logarithms of the amplitudes.

    ``near``: those at a state before.  The unknowns are averaged over a common factor of the
    field and over its term, as in the package.
    """
    layout = linear.layout
    normal = arrow(sums, linear.problem, linear.state, layout)
    model = LinearModel(normal, layout)
    # Amplitudes that have fallen to nothing do not rise again: always from above as well.
    starts = [model.start()] if near is None else [near, model.start()]
    best = max((model.best(start) for start in starts), key=lambda point: point.value)
    theta = best.theta if len(normal.C) == 1 else model.wide_shapes(best)
    log_px, k = model.form @ theta, model.octaves
    field, log_shape = Amplitudes(log_px[:k], 0.0), log_px[k + 1 :]
    solver, sigma_px = _Solver(layout), np.exp(log_shape)
    equations = eliminated(normal, layout, sigma_px)
    mean, covariance, last_octave, term, log_evidence = solver.solve(equations, field)
    by_image = _shape_sums(sums, linear, solver, mean[layout.field_at])
    posterior = Posterior(
        mean=mean,
        working=covariance,
        equations=equations,
        estimated=solver.estimated,
        field=field,
        term=term,
        shapes=Shapes(sigma_px, Amplitudes(log_shape, 0.0), by_image),
        last_octave=last_octave,
        resolved=solver.resolved(equations, covariance),
        log_evidence=log_evidence,
        layout=layout,
    )
    return posterior, best.theta
