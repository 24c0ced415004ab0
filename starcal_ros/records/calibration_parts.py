# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Parts of the record of a calibration: model checks, star trackers, and the budget of the sigma.

Also the field over the detector, which stands in addition to the lens model, with the covariance
of lines of sight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import functools
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.record_fields import Count, Finite, Quaternion, Record, Shape, Within
from starcal_ros.text import significant

TOTAL = 'total'
BUDGET_COLUMNS, BUDGET_ROWS = 9, 7
_MATTERS = 0.05  # fraction of the variance


@dataclass(frozen=True)
class HeldTerm:
    """
    An unknown that is held or has a stated prior, with its estimate from the stars.

    ``assumed`` is the held or prior value, ``estimated`` that from the stars; ``sigma`` is the
    1-sigma of their difference if the assumption is true.

    >>> round(HeldTerm('cx', assumed=319.5, estimated=320.1, sigma=0.3).significance, 6)
    2.0
    """

    name: str
    assumed: float
    estimated: float
    sigma: float

    @property
    def significance(self) -> float:
        """The difference in sigmas."""
        return abs(self.estimated - self.assumed) / self.sigma


@dataclass(frozen=True)
class DetectorStep:
    """
    The most significant step between two parts of the detector, as caused by lost columns.

    Stars beyond ``place_px`` on the axis ``across`` (u or v) are displaced by ``size_px`` along
    the axis ``moved``; ``p_value`` accounts for the number of places tested.
    """

    across: str
    place_px: float
    moved: str
    size_px: float
    p_value: float


@dataclass(frozen=True)
class ResidualBin:
    """
    Residuals of a group of stars, each predicted from the other data.

    ``by`` names the quantity that defines the group.  Residuals of images predicted from other
    images are grouped by ``radius`` (px from the middle of the detector), ``magnitude`` or
    ``image`` (its number in order of time); sums over stars by ``star`` (its number of images),
    sums over cells of the detector by ``cell`` (px from the middle), sums over stars of like
    magnitude of an image by ``brightness``.  ``low`` and ``high`` are the limits of the group.
    ``normalised`` is the RMS of the residuals over their predicted sigma, 1 if the model and its
    sigmas are right, and ``sigma`` its 1-sigma.
    """

    by: str
    low: float
    high: float
    stars: Count
    normalised: float
    sigma: float


@dataclass(frozen=True)
class Amplitude:
    """
    An estimated amplitude of errors that the model does not describe.

    ``value`` is the 1-sigma of these errors in ``unit``; ``likelihood_ratio`` is twice the log
    likelihood ratio against an amplitude of zero.  The ratio is reported only.
    """

    name: str
    value: float
    unit: str
    likelihood_ratio: float


@dataclass(frozen=True)
class ModelChecks:
    """
    Deviations of the data from the model and its priors.

    ``field_rms_px`` and ``field_worst_px`` are RMS per axis and largest length of the residual
    field over the detector.  ``image_variation_px`` is the 1-sigma change of the camera between
    images at a corner, included in the covariance.  ``predictions`` are empty with fewer than four
    images, and in older calibrations.

    >>> import starcal_ros
    >>> checks = starcal_ros.read_calibration('out').model_checks
    >>> sorted(term.name for term in checks.held if term.significance < 3.0)[:2]
    ['cx', 'cy']
    >>> checks.step.across in 'uv', checks.amplitudes[0].unit, checks.predictions[0].by
    (True, 'px', 'radius')
    """

    field_rms_px: float
    field_worst_px: float
    held: tuple[HeldTerm, ...]
    step: DetectorStep
    image_variation_px: float
    amplitudes: tuple[Amplitude, ...] = ()
    predictions: tuple[ResidualBin, ...] = ()


@dataclass(frozen=True, eq=False, repr=False)
class StarTrackerAlignment(Record):
    """
    Alignment of the camera to one of several star trackers.

    Attributes
    ----------
    frame : str
        Frame of the star tracker.
    images : int
        Number of images with an attitude from this star tracker; with 0 the mounting is the prior.
    star_tracker_from_camera_xyzw : (4,)
        Orientation of the camera in the frame of the star tracker.
    alignment_covariance_rad2 : (3, 3)
        Covariance of the passive small rotation of the camera, in the camera frame.
    first_from_star_tracker_xyzw : (4,)
        Orientation of the star tracker in the frame of the first one.
    mounting_covariance_rad2 : (3, 3)
        Covariance of a small rotation of the mounting about the axes of the camera; zero for the
        first star tracker.
    drift_arcsec_per_hour : tuple of 3 float
        Drift of the attitude against the stars, about the axes of the star tracker.
    drift_arcsec, drift_p_value : float
        Length of the drift over the time span of its images, and p-value of the hypothesis of no
        drift; NaN for fewer than four images.

    Examples
    --------
    >>> import numpy as np
    >>> zero, identity = np.zeros((3, 3)), np.array([0.0, 0.0, 0.0, 1.0])
    >>> second = StarTrackerAlignment(
    ...     'st_2', 12, identity, zero, identity, zero, (0.0, 0.0, 36.0), 18.0, 1e-4)
    >>> second.drift_arcsec / second.drift_arcsec_per_hour[2]  # hours from first to last image
    0.5
    """

    frame: str
    images: Count
    star_tracker_from_camera_xyzw: Quaternion
    alignment_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    first_from_star_tracker_xyzw: Quaternion
    mounting_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    drift_arcsec_per_hour: Annotated[tuple[float, ...], Shape((3,))]
    drift_arcsec: float
    drift_p_value: float


@dataclass(frozen=True)
class SigmaPart:
    """
    Contribution of one cause to the 1-sigma of lines of sight, RMS over the detector.

    Its square is the decrease of the variance if the cause were known exactly, or absent.
    Contributions of correlated causes overlap: their squares need not add up to the total.

    Attributes
    ----------
    cause : str
        `TOTAL` for all causes together.
    map_arcsec : float
        Of the camera alone, the common rotation removed.
    pointing_arcsec : float
        In the star tracker frame.
    assumption : str
        The value assumed or estimated for the cause.
    map_over_detector_arcsec : tuple of 63 float
        Of the camera alone at a grid of 9 columns and 7 rows of pixels from corner to corner, row
        by row; empty where it was not computed.

    Examples
    --------
    >>> import starcal_ros
    >>> total, *parts = starcal_ros.read_calibration('out').sigma_budget
    >>> total.cause, 'stars' in [part.cause for part in parts]
    ('total', True)
    """

    cause: str
    map_arcsec: float
    pointing_arcsec: float
    assumption: str
    map_over_detector_arcsec: tuple[float, ...] = ()


@dataclass(frozen=True)
class Statement:
    """
    A value of a data sheet that no option states, with the 1-sigma before and after stating it.

    ``scope`` is ``pointing``, lines of sight in the star tracker frame, or ``camera``, those of
    the camera alone, RMS over the detector; ``value`` is what the option would be set to.

    >>> str(Statement('star_tracker_slow_arcsec', '5', 'pointing', 77.0, 11.0))
    'state star_tracker_slow_arcsec: pointing 77″ becomes 11″ if it is 5'
    """

    option: str
    value: str
    scope: str
    before_arcsec: float
    after_arcsec: float

    def __str__(self) -> str:
        """Sentence for a user."""
        before, after = (significant(s, 2) for s in (self.before_arcsec, self.after_arcsec))
        text = f'state {self.option}: {self.scope} {before}″ becomes {after}″'
        return f'{text} if it is {self.value}'


def parts_that_matter(budget: Sequence[SigmaPart]) -> list[SigmaPart]:
    """Return the total, then the causes of more than 5 % of a variance, the largest first."""
    if not budget:
        return []
    total = next(part for part in budget if part.cause == TOTAL)

    def share(part: SigmaPart) -> float:
        of_map = part.map_arcsec**2 / max(total.map_arcsec**2, 1e-300)
        return max(of_map, part.pointing_arcsec**2 / max(total.pointing_arcsec**2, 1e-300))

    causes = [part for part in budget if part.cause != TOTAL and share(part) > _MATTERS]
    return [total, *sorted(causes, key=share, reverse=True)]


_DIGITS = 9  # parameters and field cancel to a thousandth and less in the factor
# Steps of a coefficient's own 1-sigma: the sigma of any line of sight holds to 3e-4.
_STEPS = 1000
_NO_VARIANCE = 1e-12  # times the largest eigenvalue: smaller ones are rounding


@dataclass(frozen=True, eq=False, repr=False)
class MapCovariance(Record):
    """
    Covariance of all that moves a line of sight.

    ``matrix`` is (k, k), of the numbers of `Derivatives.of_shape`; ``unresolved_px`` the
    1-sigma per axis of an independent displacement of each pixel, by structure of the detector
    finer than the field.

    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> camera_and_alignment = calibration.map_covariance.matrix[:13, :13]
    >>> bool(abs(camera_and_alignment / calibration.covariance - 1).max() < 1e-3)
    True
    """

    matrix: Floats
    unresolved_px: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class ResidualField(Record):
    """
    Field over the detector in addition to the lens model.

    With coefficients of zero none was found; its covariance is that of the fields that the stars
    do not rule out.  ``covariance`` is ``F F'``, plus ``R R'`` in the rows of the coefficients,
    where F is the factor and R the lower triangle with the rows ``remainder_unit_px * remainder``.
    Every sigma of a line of sight holds to 1e-3.

    Raises ValueError when remainder and units do not fit.

    Attributes
    ----------
    octaves : int
        Of its cosines; `detector_field.basis` has them.
    coefficients : (2, t)
        px, for u and for v; a star that the lens model places at u is measured at u + f(u).
    unresolved_px : float
        1-sigma per axis of structure finer than the field.
    covariance_factor : (p + 2 t, r)
        F, of the parameters of the calibration and the coefficients of u, then of v.
    remainder_unit_px : (2 t,)
    remainder : (t (2 t + 1),) int16
        Rows of the triangle, one after the other: the coefficients, the parameters known.

    Examples
    --------
    >>> import starcal_ros
    >>> field = starcal_ros.read_calibration('out').field
    >>> terms = field.coefficients.shape[1]
    >>> field.covariance.shape == (13 + 2 * terms, 13 + 2 * terms)
    True
    """

    octaves: Annotated[int, Within(1, 8)]
    coefficients: Annotated[Floats, Finite(), Shape((2, 'terms'))]
    unresolved_px: Annotated[float, Finite()]
    covariance_factor: Annotated[Floats, Finite(), Shape(('factor_rows', 'factor_cols'))]
    remainder_unit_px: Annotated[Floats, Finite(), Shape(('c',))]
    remainder: Annotated[NDArray[np.int16], Shape(('n',))]

    def __post_init__(self) -> None:
        """Check the size of the remainder."""
        count, all_of_them = len(self.remainder_unit_px), self.coefficients.size
        in_triangle = count * (count + 1) // 2
        if len(self.remainder) != in_triangle:
            raise ValueError(f'remainder: {len(self.remainder)} numbers, not {in_triangle}')
        if count not in (0, all_of_them) or count > len(self.covariance_factor):
            raise ValueError(f'remainder_unit_px: {count} numbers, not {all_of_them}')

    @property
    def rows(self) -> int:
        """Number of rows of the covariance."""
        return len(self.covariance_factor)

    @functools.cached_property
    def covariance(self) -> Floats:
        """(p + 2 t, p + 2 t): of the parameters of the calibration and the coefficients."""
        F = self.covariance_factor
        covariance: Floats = F @ F.T
        count = len(self.remainder_unit_px)
        triangle = np.zeros((count, count))
        triangle[np.tril_indices(count)] = self.remainder
        triangle *= self.remainder_unit_px[:, None]
        first = len(F) - count
        covariance[first:, first:] += triangle @ triangle.T
        return covariance

    def on(self, width: int, height: int) -> DetectorField:
        """Return the field on a detector; raises ValueError for a wrong number of terms."""
        given = self.coefficients.shape[1]
        expected = term_count(width, height, self.octaves)
        if given != expected:
            raise ValueError(f'field.coefficients: {given} for an axis, not {expected}')
        return DetectorField(width, height, self.octaves, self.coefficients)


def factored_field(of: DetectorField, covariance: MapCovariance) -> ResidualField:
    """
    Return the record of a field with the covariance of lines of sight as factor and remainder.

    The factor has the parameters exactly, and the field as it follows them.  The remainder, that
    of the field with the parameters known, displaces pixels without cancellation: a thousandth of
    the sigma of each coefficient is enough.
    """
    count, matrix = of.coefficients.size, covariance.matrix
    p = len(matrix) - count
    known = np.sqrt(np.diag(matrix)[:p])
    scale = np.where(known > 0, known, 1.0)
    values, vectors = np.linalg.eigh(matrix[:p, :p] / np.outer(scale, scale))
    used = values > _NO_VARIANCE * values.max()
    vectors, root = vectors[:, used], np.sqrt(values[used])
    factor = np.concatenate(
        [known[:, None] * vectors * root, matrix[p:, :p] / scale @ vectors / root]
    )
    factor = _to_digits(factor, _DIGITS)
    remaining = matrix[p:, p:] - factor[p:] @ factor[p:].T
    unit_px = _to_digits(np.sqrt(np.diag(remaining).clip(0.0)) / _STEPS, 4)
    steps = np.where(unit_px > 0, unit_px, np.inf)
    values, vectors = np.linalg.eigh(remaining / np.outer(steps, steps))
    # The triangle of the QR decomposition of a root exists for deficient rank too.
    _, upper = np.linalg.qr((vectors * np.sqrt(values.clip(0.0))).T)
    return ResidualField(
        octaves=of.octaves,
        coefficients=of.coefficients,
        unresolved_px=covariance.unresolved_px,
        covariance_factor=factor,
        remainder_unit_px=unit_px,
        remainder=np.rint(upper.T[np.tril_indices(count)]).astype(np.int16),
    )


def _to_digits(values: Floats, digits: int) -> Floats:
    """Return numbers rounded to so many significant digits: texts of them are as short."""
    rounded = [float(f'{value:.{digits - 1}e}') for value in values.ravel().tolist()]
    return np.array(rounded, np.float64).reshape(values.shape)
