# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Limits of the gate."""

from __future__ import annotations

from dataclasses import dataclass
import math

from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.options import option
from starcal_ros.records import GateCheck


@dataclass(frozen=True)
class GateOptions:
    """Limits that a calibration must meet to become active."""

    max_residual_rms_px: float = option(
        1.0, 'largest residual per axis over the stars used, px', low=0.0, high=100.0
    )
    max_rejected_fraction: float = option(
        0.25, 'largest fraction of stars left out as outliers', low=0.0, high=1.0
    )
    min_coverage: float = option(
        0.3,
        'smallest fraction of the focal-plane cells with at least one star used',
        low=0.0,
        high=1.0,
    )
    max_map_sigma_px: float = option(
        0.5,
        'largest 1-sigma of the distortion map over the detector, common rotation removed, px',
        low=0.0,
        high=100.0,
    )
    max_change_px: float = option(
        50.0,
        'largest change of the distortion map against the prior, common rotation removed, px',
        low=0.0,
        high=1e5,
    )
    max_rotation_deg: float = option(
        2.0,
        'largest rotation of the lines of sight in the star tracker frame against the prior, deg',
        low=0.0,
        high=180.0,
    )
    max_misfit_fraction: float = option(
        0.3, 'largest fraction of images whose attitude does not fit the others', low=0.0, high=1.0
    )
    max_line_of_sight_sigma_arcsec: float = option(
        60.0,
        'largest 1-sigma of a line of sight in the star tracker frame over the detector, arcsec',
        low=0.0,
        high=3600.0,
    )
    max_held_term_sigma: float = option(
        5.0,
        'largest distance of an unknown that is held, or has a stated prior, from the value that'
        ' the stars give it, in sigma',
        low=0.0,
        high=1e6,
    )
    max_detector_step_px: float = option(
        0.2, 'largest step between two parts of the detector, px', low=0.0, high=1e5
    )
    max_image_variation_px: float = option(
        0.3,
        '1-sigma change of the camera from image to image in a corner of the detector, px; a'
        ' smaller one is carried in the covariance',
        low=0.0,
        high=1e5,
    )
    max_cross_validated_residual: float = option(
        1.2,
        'largest RMS of residuals over their predicted sigma in a part of the data (radius,'
        ' magnitude or time), each image predicted from the others',
        low=1.0,
        high=100.0,
    )
    max_star_tracker_drift_arcsec: float = option(
        30.0,
        'largest drift of one of several star trackers against the stars over the images that it'
        ' gave the attitude of, arcsec',
        low=0.0,
        high=648000.0,
    )
    max_step_px: float = option(
        10.0,
        'largest change of the distortion map against the active calibration, common rotation'
        ' removed, px',
        low=0.0,
        high=1e5,
    )
    max_step_rotation_deg: float = option(
        0.5,
        'largest rotation of the lines of sight against the active calibration, deg',
        low=0.0,
        high=180.0,
    )


def limit_check(
    options: GateOptions | CalibrationOptions,
    option: str,
    name: str,
    found: float | str,
    unit: str = '',
) -> GateCheck:
    """A value, or the reason why there is none, against the limit of an option."""
    limit = float(getattr(options, option))
    if isinstance(found, str):
        return GateCheck(name, option, math.nan, limit, unit, None, found)
    # The condition is the one that must hold, so that NaN fails: a comparison with it is false.
    passed = found >= limit if option.startswith('min_') else found <= limit
    return GateCheck(name, option, float(found), limit, unit, bool(passed))
