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
    Residuals of images that the other images predict, in a part of the data.

    Attributes
    ----------
    by : str
        ``radius`` (px from the middle of the detector), ``magnitude`` or ``image`` (its number in
        order of time).
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
class ModelChecks:
    """
    Tests of the model that the calibration assumes.

    Attributes
    ----------
    field_p_value : float
        Probability of the residuals if the lens model describes the lens; NaN where not tested.
    field_rms_px, field_worst_px : float
        Field that was estimated beside the lens model, RMS per axis and largest length over the
        detector; 0 where none was needed.
    held : tuple of HeldTerm
    step : DetectorStep
    velocity_error_km_s, velocity_sigma_km_s, velocity_p_value : float
        Velocity of the observer that the aberration of the stars misses, its largest 1-sigma, and
        the p-value of none.
    image_variation_px, image_variation_p_value : float
        1-sigma change of the camera from image to image in a corner, carried in the covariance;
        and the p-value of none.
    correlation_time_s, independent_images : float
        Of the star-tracker errors: 0 where they are independent; and how many independent images
        determine the alignment as well.
    pointings : int
        Number of different pointings.
    independent_pointings : float
        Number of images; one that repeats the stars of others counts by its new information.
    cross_validation : tuple of ResidualBin
        Empty where it was not made: fewer than four images, or an older calibration.
    """

    field_p_value: float
    field_rms_px: float
    field_worst_px: float
    held: tuple[HeldTerm, ...]
    step: DetectorStep
    velocity_error_km_s: float
    velocity_sigma_km_s: float
    velocity_p_value: float
    image_variation_px: float
    image_variation_p_value: float
    correlation_time_s: float
    independent_images: float
    pointings: int
    independent_pointings: float
    cross_validation: tuple[ResidualBin, ...] = ()
