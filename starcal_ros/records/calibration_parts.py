# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parts of a calibration: model checks, star trackers, and the budget of the sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from starcal_ros.arrays import Floats
from starcal_ros.record_fields import Count, Finite, Quaternion, Shape

TOTAL = 'total'
BUDGET_COLUMNS, BUDGET_ROWS = 9, 7
_MATTERS = 0.05  # fraction of the variance


@dataclass(frozen=True)
class HeldTerm:
    """
    An unknown that is held or has a stated prior, with its estimate from the stars.

    ``assumed`` is the held or prior value, ``asked`` the estimate from the stars, ``sigma`` the
    1-sigma of their difference if the assumption is true.
    """

    name: str
    assumed: float
    asked: float
    sigma: float

    @property
    def significance(self) -> float:
        """The difference in sigmas."""
        return abs(self.asked - self.assumed) / self.sigma


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
    sums over cells of the detector by ``cell`` (px from the middle).  ``low`` and ``high`` are the
    limits of the group.  ``normalised`` is the RMS of the residuals over their predicted sigma, 1
    if the model and its sigmas are right, and ``sigma`` its 1-sigma.
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
    """

    field_rms_px: float
    field_worst_px: float
    held: tuple[HeldTerm, ...]
    step: DetectorStep
    image_variation_px: float
    amplitudes: tuple[Amplitude, ...] = ()
    predictions: tuple[ResidualBin, ...] = ()


@dataclass(frozen=True)
class StarTrackerAlignment:
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
    """

    cause: str
    map_arcsec: float
    pointing_arcsec: float
    assumption: str
    map_over_detector_arcsec: tuple[float, ...] = ()


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
