# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A smooth field over the detector that the lens model lacks: its test, its prior and its modes.

The calibration with a field predicts ``u = g(e; xi) + f(u)`` with ``f = Phi(u) c``, Phi the
polynomials of `detector_field` and ``c ~ N(0, s^2 P W P)``.  W is the covariance of a Gaussian
process with a squared-exponential kernel of length l, a part of it shorter (Rasmussen & Williams
2006, ch. 4 and 5), projected onto the polynomials, and of the terms that larger lens models have.
P removes from it what the camera parameters and a common rotation can do, so that the lens model
describes as much as it can.  Amplitude s and length l are those of the largest marginal
likelihood.

A figure error of a lens often has one dominant wave.  A kernel that oscillates, the first one
times ``cos(k_u du) cos(k_v dv)`` with a long envelope (a spectral mixture, Wilson & Adams 2013),
replaces 98 % of the kernel of a component of the field where its likelihood is much larger.

With F the information on c and g its gradient, all other unknowns eliminated, the likelihood ratio
against s = 0 is ``2 log L = sum z_i^2 s^2 L_i / (1 + s^2 L_i) - log(1 + s^2 L_i)`` over the
eigenvalues L_i of ``W^(1/2) F W^(1/2)``; z_i is the gradient along them in sigma.

Such a ratio is spread over all shapes of a field.  What lenses lack most often is the next radial
term, and one shape alone is found at half the size, so it has a test of its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.camera import (
    CameraModel,
    line_of_sight,
    pixel_grid,
    project_jacobians,
)
from starcal_ros.detector_field import basis, degrees, DetectorField, legendre
from starcal_ros.least_squares.linear_terms import Scalars, Score

TEST_DEGREE = 10
_MAX_DEGREE = 18
# Length of the kernel in half lengths of the longer side.  Polynomials of degree 4.2 / length hold
# all but 1e-4 of its variance.
# Lens errors grow towards the corners: a part of the variance has half and a third of the length,
# as a rational-quadratic kernel has.  Without it the corners of an 8th-order term of 3 px were 2.6
# sigma off.
_SCALES = ((1.0, 0.9), (0.5, 0.09), (0.33, 0.01))
_LENGTHS = (0.26, 0.3, 0.36, 0.43, 0.52, 0.7, 1.0, 1.4, 2.0)
_DEGREE_TIMES_LENGTH = 4.2
_ENVELOPES = (1.0, 2.0, 4.0, 8.0)  # of a wave: lengths in half lengths of the longer side
_SHARE_OF_WAVE = 0.98  # of the variance of a component that has a wave
_LEAST_GAIN = 20.0  # of twice the log likelihood, for four more numbers that were looked for
_FASTEST = 16.0  # rad per half length: 2.5 waves across the longer side
_WAVE_STEP = 0.8  # rad per half length, at first: half the width of a line over the detector
_REFINEMENTS = 3
_BEYOND_WAVE = 9.0  # degrees beyond the wave number that hold all but 1e-4 of a wave
_AMPLITUDES_PX = np.geomspace(1e-3, 10.0, 41)
_UNSEEN_PX = np.geomspace(1e-5, 10.0, 61)  # from what no stars show to what all show
_GRID = 41  # pixels a side at which the lens model's own displacements are taken
# Of the detector, with a line of sight: a circular image fills 0.4 of a wide one; a lens model
# that stars in one spot determine folds back around them.
_LEAST_SEEN = 0.25
_LEAST_SHARE = 1e-8  # of the variance of a field, under which a mode is left out


@dataclass(frozen=True)
class Wave:
    """Wave numbers along u and v, rad per half length of the longer side, and envelope length."""

    along_u: float
    along_v: float
    envelope: float


Waves = tuple[Wave | None, Wave | None]
"""Dominant wave of the u and of the v component."""
NO_WAVES: Waves = (None, None)


@dataclass(frozen=True)
class FieldPrior:
    """
    A prior of the field: ``c = modes z`` with ``z ~ N(0, I)``.

    Attributes
    ----------
    width, height : int
        Of the detector, px.
    degree : int
    modes : (2 t, r)
        Coefficients of the polynomials, for u then for v, of each mode, px.
    amplitude_px : float
        s: prior RMS of each component of the field before P.
    length : float
        l, in half lengths of the longer side of the detector.
    log_likelihood_ratio : float
        Twice the logarithm, against no field.
    radial_score : float
        Gradient along the radial term of 8th order, in sigma.
    waves : Waves
    """

    width: int
    height: int
    degree: int
    modes: Floats
    amplitude_px: float
    length: float
    log_likelihood_ratio: float
    radial_score: float
    waves: Waves = NO_WAVES

    def is_close_to(self, other: FieldPrior) -> bool:
        """Whether the two stand at the same place of the search, or next to it in amplitude."""
        apart = abs(np.log(self.amplitude_px / other.amplitude_px))
        step = np.log(_AMPLITUDES_PX[1] / _AMPLITUDES_PX[0])
        same = (self.degree, self.length) == (other.degree, other.length)
        return bool(same and apart < 1.5 * step)

    def field(self, amplitudes: Floats) -> DetectorField:
        """Return the field of the amplitudes (r,) of the modes."""
        coefficients = (self.modes @ amplitudes).reshape(2, -1)
        return DetectorField(self.width, self.height, self.degree, coefficients)

    @property
    def polynomials(self) -> Scalars:
        """The polynomials of ``modes`` as functions of the pixel."""
        return polynomials(self.width, self.height, self.degree)

    @property
    def p_value(self) -> float:
        """
        Probability of as large a ratio, or as large a radial term, without a field.

        The variance stands at its bound under the null hypothesis, which halves the tail of chi^2
        with one degree of freedom (Self & Liang 1987).  The radial term is Gaussian.  The smaller
        of the two counts twice (Bonferroni).  Of 20,000 draws without a field, for 14 images
        and for 4, 1.0 and 0.8 % have a p-value under 1 %.
        """
        smooth = 0.5 * chdtrc(1.0, max(self.log_likelihood_ratio, 0.0))
        return float(min(1.0, 2.0 * min(smooth, chdtrc(1.0, self.radial_score**2))))


def polynomials(width: int, height: int, degree: int) -> Scalars:
    """Return the polynomials of a detector as functions of the pixel."""
    return lambda pixels: basis(pixels.T, width, height, degree).T


def sees_detector(camera: CameraModel) -> bool:
    """Whether the lens model has lines of sight for enough of the detector to hold a field."""
    seen = np.isfinite(line_of_sight(camera, pixel_grid(camera, _GRID, _GRID))[:, 0])
    return bool(seen.mean() >= _LEAST_SEEN)


def spanned_by_lens(camera: CameraModel, free: NDArray[np.int64], degree: int) -> Floats:
    """
    Return an orthonormal basis (2 t, r) of what the lens model and a rotation explain.

    ``free`` are the camera parameters that are estimated.
    """
    pixels = pixel_grid(camera, _GRID, _GRID)
    directions = line_of_sight(camera, pixels)
    seen = np.isfinite(directions[:, 0])
    _, J_parameters, J_rotation = project_jacobians(camera, directions[seen])
    J = np.concatenate([J_parameters[..., free], J_rotation], axis=-1)
    phi = basis(pixels[seen], camera.width, camera.height, degree)
    J = J / np.linalg.norm(J, axis=(0, 1))
    found = np.linalg.lstsq(phi, J.transpose(0, 2, 1).reshape(len(phi), -1), rcond=None)[0]
    found = found.reshape(phi.shape[1], J.shape[2], 2).transpose(2, 0, 1).reshape(-1, J.shape[2])
    left, singular, _ = np.linalg.svd(found, full_matrices=False)
    spanned: Floats = left[:, singular > 1e-6 * singular[0]]
    return spanned


@functools.lru_cache(maxsize=16)
def _kernel_root(
    width: int, height: int, degree: int, length: float, wave: Wave | None = None
) -> Floats:
    """Return L (t, r) with ``L L' = W``, the covariance of the coefficients of one component."""
    nodes, weights = _quadrature()
    polynomials = legendre(nodes, degree) * (0.5 * weights)

    def along(side: int, own: float, wave_number: float = 0.0) -> Floats:
        apart = (nodes[:, None] - nodes[None, :]) * (side / max(width, height))
        kernel = np.exp(-0.5 * (apart / own) ** 2) * np.cos(wave_number * apart)
        return np.asarray(polynomials @ kernel @ polynomials.T)

    def both(u: Floats, v: Floats) -> Floats:
        return np.asarray(u[np.ix_(of_u, of_u)] * v[np.ix_(of_v, of_v)])

    of_u, of_v = degrees(degree).T
    covariance: Floats = np.zeros((len(of_u), len(of_u)))
    for part, share in _SCALES:
        covariance += share * both(along(width, part * length), along(height, part * length))
    if wave is not None:
        u = along(width, wave.envelope, wave.along_u)
        v = along(height, wave.envelope, wave.along_v)
        covariance = _SHARE_OF_WAVE * both(u, v) + (1.0 - _SHARE_OF_WAVE) * covariance
    values, vectors = np.linalg.eigh(covariance)
    large = values > _LEAST_SHARE * values.sum()
    root = vectors[:, large] * np.sqrt(values[large])
    root.setflags(write=False)
    return np.asarray(root)


@functools.cache
def _quadrature() -> tuple[Floats, Floats]:
    """Nodes (64,) and weights (64,) of Gauss and Legendre."""
    return np.polynomial.legendre.leggauss(64)


@dataclass(frozen=True)
class FieldLikelihood:
    """Score of the polynomials of a detector, less what the lens model explains."""

    camera: CameraModel
    degree: int
    span: Floats
    information: Floats
    gradient: Floats
    patterns: Floats

    def root(self, length: float, waves: Waves) -> Floats:
        """Root of the prior covariance of an amplitude of 1 px."""
        size = self.camera.width, self.camera.height
        u, v = (_kernel_root(*size, self.degree, length, wave) for wave in waves)
        zero = np.zeros((len(u), v.shape[1])), np.zeros((len(v), u.shape[1]))
        return np.concatenate([np.block([[u, zero[0]], [zero[1], v]]), self.patterns], axis=1)

    def best_amplitude(self, length: float, waves: Waves) -> tuple[float, float]:
        """Twice the log of the largest likelihood ratio, and the amplitude in px."""
        ratio = self.ratios(self.root(length, waves), _AMPLITUDES_PX)
        k = int(ratio.argmax())
        return float(ratio[k]), float(_AMPLITUDES_PX[k])

    def ratios(self, root: Floats, amplitudes_px: NDArray[np.floating]) -> Floats:
        """Twice the log of the likelihood ratios (k,) of amplitudes, to no field."""
        eigenvalues, vectors = np.linalg.eigh(root.T @ self.information @ root)
        eigenvalues = np.maximum(eigenvalues, 0.0)
        along = vectors.T @ (root.T @ self.gradient)
        s2 = amplitudes_px[:, None] ** 2
        shrunk = 1.0 + s2 * eigenvalues
        return np.asarray((along**2 * s2 / shrunk - np.log(shrunk)).sum(axis=1))

    def radial_score(self) -> float:
        """Gradient along the radial pattern, in sigma; 0 where the stars say nothing about it."""
        radial = self.patterns[:, 0]
        information = float(radial @ self.information @ radial)
        return float(radial @ self.gradient) / np.sqrt(information) if information > 0 else 0.0

    def posterior_mean(self, length: float, waves: Waves, amplitude_px: float) -> Floats:
        """Coefficients (2 t,) of the field of largest posterior probability."""
        modes = amplitude_px * self.root(length, waves)
        held = modes.T @ self.information @ modes + np.eye(modes.shape[1])
        return np.asarray(modes @ np.linalg.solve(held, modes.T @ self.gradient))


def best_prior(
    shown: FieldLikelihood, waves: Waves = NO_WAVES, looks_for_waves: bool = False
) -> FieldPrior:
    """
    Return the prior of the largest marginal likelihood.

    Parameters
    ----------
    shown : FieldLikelihood
        At a field of zero.
    waves : Waves
        Dominant waves.
    looks_for_waves : bool
        Whether better ones are looked for, from those given or from the spectrum; never in the
        test of no field, whose p-value is of smooth kernels.
    """
    camera, span = shown.camera, shown.span
    known = waves
    found = [(*shown.best_amplitude(length, known), length) for length in _LENGTHS]
    ratio, amplitude_px, length = max(found)
    if looks_for_waves:
        mean = shown.posterior_mean(length, known, amplitude_px)
        for candidate in _candidates(shown, length, known, mean):
            again = shown.best_amplitude(length, candidate)
            more = known.count(None) - candidate.count(None)
            if again[0] > ratio + _LEAST_GAIN * max(more, 0):
                known, (ratio, amplitude_px) = candidate, again
    root = shown.root(length, known)
    modes = amplitude_px * (root - span @ (span.T @ root))
    return FieldPrior(
        camera.width,
        camera.height,
        shown.degree,
        modes,
        amplitude_px,
        length,
        ratio,
        shown.radial_score(),
        known,
    )


def unseen_prior(shown: FieldLikelihood, tested: FieldPrior) -> FieldPrior:
    """
    Return the prior of what may be there where the test shows no field.

    A camera that is exactly its lens model does not exist, and stars that do not show a term do
    not exclude it.  The field has the patterns that lens models have next, all of one amplitude s,
    and before the stars are asked every factor of ten of s from 1e-5 to 10 px is as likely.  The
    amplitude of the prior is the root of the mean of s^2 that the stars leave.

    ``tested`` is the answer of `best_prior`, without waves.
    """
    log_ratio = 0.5 * shown.ratios(shown.patterns, _UNSEEN_PX)
    weight = np.exp(log_ratio - log_ratio.max())
    amplitude_px = float(np.sqrt(weight @ _UNSEEN_PX**2 / weight.sum()))
    modes = amplitude_px * shown.patterns
    return dataclasses.replace(tested, modes=modes, amplitude_px=amplitude_px)


def field_likelihood(
    score: Score, camera: CameraModel, free: NDArray[np.int64], degree: int
) -> FieldLikelihood:
    """
    Return the likelihood of fields beside a lens model.

    Parameters
    ----------
    score : Score
        Of the terms of `polynomials` of that degree, at a field of zero.
    camera : CameraModel
    free : (f,) int
        Camera parameters that are estimated.
    degree : int
    """
    span = spanned_by_lens(camera, free, degree)
    return FieldLikelihood(
        camera,
        degree,
        span,
        _projected(_projected(score.information, span).T, span),
        score.gradient - span @ (span.T @ score.gradient),
        _patterns(camera.width, camera.height, degree, span),
    )


def _candidates(
    shown: FieldLikelihood, length: float, known: Waves, mean: Floats
) -> tuple[Waves, ...]:
    """Waves of one component or of both, near known ones or by the mean field (2 t,)."""
    # The amplitude is that of both components: each wave is looked for beside one of the other.
    u, v = (
        wave or Wave(*_dominant_wave(shown.camera, shown.degree, component), _ENVELOPES[1])
        for wave, component in zip(known, np.split(mean, 2), strict=True)
    )
    u, _ = _refined(shown, length, (u, v), 0)
    u, v = _refined(shown, length, (u, v), 1)
    return (u, None), (None, v), (u, v)


def _refined(
    shown: FieldLikelihood, length: float, waves: tuple[Wave, Wave], component: int
) -> tuple[Wave, Wave]:
    """Waves with the most likely one in a component, near the one that it has."""

    def with_wave(wave: Wave) -> tuple[Wave, Wave]:
        return (wave, waves[1]) if component == 0 else (waves[0], wave)

    def likelihood(wave: Wave) -> float:
        return shown.best_amplitude(length, with_wave(wave))[0]

    wave = waves[component]
    found = []
    # A long envelope has a narrow line: it is looked for where a shorter one has found it.
    for envelope in _ENVELOPES:
        wave = dataclasses.replace(wave, envelope=envelope)
        value, step = likelihood(wave), _WAVE_STEP / envelope
        for _ in range(_REFINEMENTS):
            around = [
                Wave(abs(wave.along_u + i * step), abs(wave.along_v + j * step), envelope)
                for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))
            ]
            values = [likelihood(one) for one in around]
            k = int(np.argmax(values))
            if values[k] > value:
                value, wave = values[k], around[k]
            else:
                step *= 0.5
        found.append((value, envelope, wave))
    return with_wave(max(found)[2])


def _dominant_wave(camera: CameraModel, degree: int, coefficients: Floats) -> tuple[float, float]:
    """Wave numbers along u and v of the largest power of a component of a field."""
    longer = max(camera.width, camera.height)
    u = np.linspace(0.0, camera.width - 1.0, _GRID)
    v = np.linspace(0.0, camera.height - 1.0, _GRID)
    pixels = np.stack([grid.ravel() for grid in np.meshgrid(u, v)], axis=-1)
    values = basis(pixels, camera.width, camera.height, degree) @ coefficients
    numbers = np.arange(0.0, _FASTEST, _WAVE_STEP)
    along_u = np.exp(1j * np.outer(numbers, 2.0 * u / longer))
    along_v = np.exp(1j * np.outer(numbers, 2.0 * v / longer))
    image = values.reshape(_GRID, _GRID)
    power = sum(np.abs(one @ image @ along_u.T) ** 2 for one in (along_v, along_v.conj()))
    j, i = np.unravel_index(int(np.argmax(power)), (len(numbers), len(numbers)))
    return float(numbers[i]), float(numbers[j])


def degree_for(prior: FieldPrior) -> int:
    """Return the degree of the polynomials that hold a field of this length and these waves."""
    needed = _DEGREE_TIMES_LENGTH / (_SCALES[-1][0] * prior.length)
    for wave in prior.waves:
        if wave is not None:
            needed = max(needed, wave.along_u + _BEYOND_WAVE, wave.along_v + _BEYOND_WAVE)
    return min(_MAX_DEGREE, max(TEST_DEGREE, int(np.ceil(needed))))


def _projected(matrix: Floats, span: Floats) -> Floats:
    """Return the matrix less what its columns have of a span."""
    return np.asarray(matrix - span @ (span.T @ matrix))


def _patterns(width: int, height: int, degree: int, span: Floats) -> Floats:
    """
    Coefficients (2 t, 7) of the terms that lens models have next, less what the lens model spans.

    Radial of 8th order, thin prism of 2nd and 4th order, tilt; each with a mean square of 1.
    """
    patterns = _projected(_pattern_coefficients(width, height, degree), span)
    return np.asarray(patterns / np.linalg.norm(patterns, axis=0))


@functools.lru_cache(maxsize=8)
def _pattern_coefficients(width: int, height: int, degree: int) -> Floats:
    """Coefficients (2 t, 7) of the patterns as they are."""
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    half = np.array([width - 1, height - 1]) / 2.0
    xy = (pixels - half) / float(np.hypot(*half))
    x, y = xy.T
    r2 = x * x + y * y
    zero = np.zeros_like(x)
    moved = [
        (x * r2**4, y * r2**4),
        *((power, zero) for power in (r2, r2**2)),
        *((zero, power) for power in (r2, r2**2)),
        (x * x, x * y),
        (x * y, y * y),
    ]
    phi = basis(pixels, width, height, degree)
    both = np.concatenate([np.stack(axis, axis=-1) for axis in zip(*moved, strict=True)], axis=1)
    along_u, along_v = np.split(np.linalg.lstsq(phi, both, rcond=None)[0], 2, axis=1)
    coefficients = np.concatenate([along_u, along_v])
    coefficients.setflags(write=False)
    return np.asarray(coefficients)
