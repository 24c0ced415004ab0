# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records of the checks of the model that a calibration assumes."""

from __future__ import annotations

from dataclasses import dataclass

from starcal_ros.arrays import Count


@dataclass(frozen=True)
class HeldTerm:
    """
    A camera parameter that is held or bound by its prior, with its estimate from the stars.

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
    The most significant step between two parts of the detector, as lost columns make one.

    The stars beyond ``place_px`` along the axis ``across`` (u or v) are moved along the axis
    ``moved`` by ``size_px``; ``p_value`` accounts for all places that were looked at.
    """

    across: str
    place_px: float
    moved: str
    size_px: float
    p_value: float


@dataclass(frozen=True)
class ResidualBin:
    """
    Residuals of what the others predict, in a part of the data.

    Attributes
    ----------
    by : str
        ``radius`` (px from the middle of the detector), ``magnitude`` or ``image`` (its number in
        order of time) for images that others predict; ``star`` (its number of images) or ``cell``
        (px from the middle) for sums over stars and cells of the detector.
    low, high : float
        Of the part.
    stars : int
    normalised : float
        RMS of the residuals over their predicted sigma: 1 where the model and its sigmas hold.
    sigma : float
        1-sigma of that by the number of stars.
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

    Attributes
    ----------
    name : str
    value : float
        1-sigma, in ``unit``.
    unit : str
    likelihood_ratio : float
        Twice the log likelihood against none; it decides nothing.
    """

    name: str
    value: float
    unit: str
    likelihood_ratio: float


@dataclass(frozen=True)
class ModelChecks:
    """
    What the data show beyond the model and its priors.

    Attributes
    ----------
    field_rms_px, field_worst_px : float
        Field beside the lens model, RMS per axis and largest length over the detector.
    held : tuple of HeldTerm
        Unknowns that are held, or that have a stated prior.
    step : DetectorStep
    image_variation_px : float
        1-sigma change of the camera from image to image in a corner, carried in the covariance.
    amplitudes : tuple of Amplitude
    predictions : tuple of ResidualBin
        Empty where they were not made: fewer than four images, or an older calibration.
    """

    field_rms_px: float
    field_worst_px: float
    held: tuple[HeldTerm, ...]
    step: DetectorStep
    image_variation_px: float
    amplitudes: tuple[Amplitude, ...] = ()
    predictions: tuple[ResidualBin, ...] = ()
