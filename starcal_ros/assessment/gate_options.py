# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Limits of the gate."""

from __future__ import annotations

from dataclasses import dataclass

from starcal_ros.estimation.calibration_options import CalibrationOptions
from starcal_ros.options import option
from starcal_ros.records import GateCheck


@dataclass(frozen=True)
class GateOptions:
    """Limits of the gate: a calibration that exceeds one is not activated."""

    max_residual_rms_px: float = option(
        1.0, 'largest RMS residual per axis of the stars used, px', low=0.0, high=100.0
    )
    max_rejected_fraction: float = option(
        0.25,
        'largest fraction of stars rejected as outliers, and of images with an attitude that'
        ' contradicts the other images',
        low=0.0,
        high=1.0,
    )
    min_coverage: float = option(
        0.3, 'smallest fraction of detector cells with a star used', low=0.0, high=1.0
    )
    max_map_sigma_px: float = option(
        0.5,
        'largest 1-sigma of the distortion map on the detector, common rotation removed, px',
        low=0.0,
        high=100.0,
    )
    max_change_px: float = option(
        10.0,
        'largest change of the distortion map from the active calibration, common rotation'
        ' removed, px; without one five times as much from the prior',
        low=0.0,
        high=1e5,
    )
    max_rotation_deg: float = option(
        0.4,
        'largest rotation of the lines of sight from the active calibration in the star tracker'
        ' frame, degrees; without one five times as much from the prior',
        low=0.0,
        high=180.0,
    )
    max_line_of_sight_sigma_arcsec: float = option(
        120.0,
        'largest 1-sigma of a line of sight on the detector in the star tracker frame, arcsec',
        low=0.0,
        high=3600.0,
    )
    max_held_term_sigma: float = option(
        5.0,
        'largest difference between the prior and the estimate from the stars, in sigma, for each'
        ' unknown that is held or has a stated prior',
        low=0.0,
        high=1e6,
    )
    max_detector_step_px: float = option(
        0.2, 'largest step between two parts of the detector, px', low=0.0, high=1e5
    )
    max_image_variation_px: float = option(
        0.3,
        'largest 1-sigma change of the camera from image to image at a detector corner, px;'
        ' smaller ones are in the covariance of the camera that images share',
        low=0.0,
        high=1e5,
    )
    max_cross_validated_residual: float = option(
        1.2,
        'largest RMS of residuals over their predicted sigma in any group of stars (by radius,'
        ' magnitude or time), with each image predicted from the others',
        low=1.0,
        high=100.0,
    )
    max_star_tracker_drift_arcsec: float = option(
        30.0,
        'largest drift of each star tracker over its own images, if there are several, arcsec',
        low=0.0,
        high=648000.0,
    )


def limit_check(
    options: GateOptions | CalibrationOptions,
    option: str,
    name: str,
    found: float,
    unit: str = '',
    remedy: str = '',
    factor: float = 1.0,
) -> GateCheck:
    """
    A value against a multiple of the limit of an option.

    The remedy is the note of a check that failed.
    """
    limit = factor * float(getattr(options, option))
    # The condition is the one that must hold, so that NaN fails: a comparison with it is false.
    passed = found >= limit if option.startswith('min_') else found <= limit
    note = '' if passed else remedy
    return GateCheck(name, option, float(found), limit, unit, bool(passed), note)
