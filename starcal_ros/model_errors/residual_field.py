# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A smooth field over the detector that the lens model lacks: its test, its prior and its modes.

The calibration with a field predicts ``u = g(e; xi) + f(u)`` with ``f = Phi(u) c``, Phi the
polynomials of `detector_field` and ``c ~ N(0, s^2 P W P)``.  W is the covariance of `field_kernel`
for each component, and of the terms that larger lens models have.  P removes from it what the
camera parameters and a common rotation can do, so that the lens model describes as much as it can.
Amplitude s and length are those of the largest marginal likelihood (`field_likelihood`).

A figure error of a lens often has one dominant wave (`wave_search`): a component has one where its
likelihood is much larger with it.

A likelihood ratio is spread over all shapes of a field.  What lenses lack most often is the next
radial term, and one shape alone is found at half the size, so it has a test of its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.detector_field import DetectorField
from starcal_ros.least_squares.linear_terms import Scalars
from starcal_ros.model_errors.field_kernel import NO_WAVES, Waves
from starcal_ros.model_errors.field_likelihood import (
    AMPLITUDES_PX,
    FieldLikelihood,
    polynomials,
)
from starcal_ros.model_errors.wave_search import candidates

# Of the kernel, in half lengths of the longer side.
_LENGTHS = (0.26, 0.3, 0.36, 0.43, 0.52, 0.7, 1.0, 1.4, 2.0)
_LEAST_GAIN = 20.0  # of twice the log likelihood, for four more numbers that were looked for
_UNSEEN_PX = np.geomspace(1e-5, 10.0, 61)  # from what no stars show to what all show


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
        step = np.log(AMPLITUDES_PX[1] / AMPLITUDES_PX[0])
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
        for candidate in candidates(shown, length, known, mean):
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
