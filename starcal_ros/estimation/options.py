# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Options of a calibration, and whether an ensemble is enough for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import ALL_PARAMETER_NAMES, parameter_names
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.problem import METHODS
from starcal_ros.options import option
from starcal_ros.records import Ensemble
from starcal_ros.text import counted

_USUAL_TRACKER_ARCSEC = 10.0  # until the scatter of the images replaces it


@dataclass(frozen=True)
class CalibrationOptions:
    """
    Unknowns of the calibration and their prior uncertainties.

    The last five fields are constants in flight: no data sheet states them.
    """

    method: str = option(
        'hierarchical',
        'model of the image attitudes; hierarchical: star tracker with zero-mean errors;'
        ' per_image: a free attitude for each image; single: attitudes without error',
        choices=METHODS,
    )
    estimate: tuple[str, ...] = option(
        ('fx', 'skew', 'fy', 'cx', 'cy', 'distortion'),
        'camera parameters to estimate; the others keep their prior values; distortion: all'
        ' coefficients of the lens model',
        choices=(*ALL_PARAMETER_NAMES, 'distortion'),
        basic=True,
    )
    star_tracker_sigma_arcsec: tuple[float, ...] = option(
        (0.0, 0.0, 0.0),
        '1-sigma noise of the star tracker attitude about its x, y, z axes, arcsec; zeros:'
        ' estimated from the scatter of the images',
        low=0.0,
        high=3600.0,
        length=3,
        basic=True,
    )
    min_images: int = option(3, 'smallest number of images in a calibration', low=1, high=100000)
    max_images: int = option(
        400,
        'largest number of images kept; beyond it the least informative images are dropped',
        low=3,
        high=100000,
    )
    prior_sigma: tuple[float, ...] = option(
        (0.0,),
        '1-sigma uncertainty of the prior fx, skew, fy, cx, cy (px) and lens coefficients, or one'
        ' number for all; 0: exact if held; if estimated cx and cy within 3 % of the longer image'
        ' side, coefficients within a tenth of the half diagonal in the corners, no prior of fx,'
        ' skew, fy',
        low=0.0,
    )
    star_tracker_mounting_sigma_arcsec: float = option(
        300.0,
        '1-sigma uncertainty of each angle between the prior mountings of several star trackers,'
        ' arcsec',
        low=1e-3,
        high=648000.0,
    )
    velocity_sigma_m_s: float = option(
        -1.0,
        '1-sigma uncertainty of each component of the observer velocity, m/s; -1: 10 with a'
        ' velocity input, 20000 (an orbit about the Earth or the Sun) without one or with one'
        ' under 11200, which may be about the Earth (state 10 if not), 0 on the ground; 8000 in an'
        ' orbit about the Earth',
        low=-1.0,
        high=3e5,
    )
    shutter: str = option(
        'unknown',
        'shutter of the camera; global: all rows are exposed at once; rolling: one row after'
        ' another over readout_s, the middle row at the image stamp; unknown: the readout time is'
        ' estimated, with a prior 1-sigma of 20 ms',
        choices=('global', 'rolling', 'unknown'),
        basic=True,
    )
    readout_s: float = option(
        0.0,
        'time from the first to the last row of a rolling shutter, accurate to 1 %, s; negative:'
        ' the last row is read first',
        low=-10.0,
        high=10.0,
    )
    stamp_sigma_s: float = option(
        0.005,
        '1-sigma uncertainty of a constant offset between image and attitude stamps, s',
        low=0.0,
        high=10.0,
    )
    star_tracker_slow_arcsec: float = option(
        0.0,
        '1-sigma of star tracker errors that persist from image to image, arcsec; 0: estimated'
        ' from the images, starting at the level of the noise',
        low=0.0,
        high=3600.0,
    )
    lens_residual_px: float = option(
        0.0,
        'rms residual per axis of the lens model by the ground calibration, accurate to a factor'
        ' of 4, px; 0: not known',
        low=0.0,
        high=0.5,
    )
    focal_temperature_order: int = option(
        0, 'degree of the focal length polynomial in temperature; 0: constant', low=0, high=2
    )
    alignment_temperature: bool = option(
        False, 'estimate an alignment that is linear in temperature; not with method: per_image'
    )
    min_stars: int = 60  # observations in a calibration: about five for each unknown of a camera
    # The limit rejects one good star of 2000 in 12 calibrations.
    outlier_sigma: float = 4.5
    # 1-sigma of cx and cy, as a fraction of the longer side: how far mounts decentre detectors.
    principal_point_prior: float = 0.03
    # 1-sigma of each lens coefficient: displacement of the corners, of the half diagonal; it falls
    # with the field beyond the third order.
    lens_prior: float = 0.1
    variance_components: bool = True  # sigmas of centroids and star tracker from the residuals


def check_options(options: CalibrationOptions, model: str) -> None:
    """
    Raise `OptionError` for options that contradict each other or the lens model.

    Raises
    ------
    OptionError
        Naming the option.
    """
    if options.alignment_temperature and options.method == 'per_image':
        # The mean of the images' alignments cannot have a slope: `hierarchical` with a large star
        # tracker sigma is the same estimate and can.
        raise OptionError('alignment_temperature: the method per_image has no common alignment')
    if tracker_sigma_is_given(options) and min(options.star_tracker_sigma_arcsec) < 1e-3:
        raise OptionError(
            f'star_tracker_sigma_arcsec: {list(options.star_tracker_sigma_arcsec)} has a sigma of'
            ' zero; give three, or none'
        )
    if options.shutter == 'rolling' and not options.readout_s:
        raise OptionError(
            'readout_s: not set, which shutter: rolling needs; without it, shutter: unknown'
        )
    if options.shutter != 'rolling' and options.readout_s:
        raise OptionError(
            f'readout_s: {options.readout_s:g} s, but shutter is {options.shutter}; set rolling'
        )
    names = parameter_names(model)
    for name in estimated_parameters(options, model):
        if name not in names:
            raise OptionError(
                f'estimate: {name} is not a parameter of the lens model {model}, which has '
                + ', '.join(names)
            )
    if len(options.prior_sigma) not in (1, len(names)):
        raise OptionError(
            f'prior_sigma: {len(options.prior_sigma)} numbers, but the lens model {model} has '
            f'{len(names)} parameters: {", ".join(names)}'
        )


def tracker_sigma_is_given(options: CalibrationOptions) -> bool:
    """True if the options state a star tracker sigma, which the scatter of images then refines."""
    return any(options.star_tracker_sigma_arcsec)


def assumed_tracker_sigma_rad(options: CalibrationOptions) -> Floats:
    """1-sigma (3,) of the star tracker at the start of an estimate."""
    if not tracker_sigma_is_given(options):
        return np.full(3, _USUAL_TRACKER_ARCSEC * ARCSECOND_RAD)
    return np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD


def estimated_parameters(options: CalibrationOptions, model: str) -> tuple[str, ...]:
    """Names of the estimated camera parameters of a lens model."""
    return tuple(
        name
        for asked in options.estimate
        for name in (LENSES[model].coefficients if asked == 'distortion' else (asked,))
    )


def check_enough(ensemble: Ensemble, options: CalibrationOptions) -> None:
    """
    Raise `TooFewObservations` with the number of missing images or stars.

    Raises
    ------
    TooFewObservations
        A sentence for a person.
    """
    images, stars = len(ensemble.images), ensemble.star_count
    missing = []
    if images < options.min_images:
        missing.append(
            f'{counted(options.min_images - images, "more image")} '
            f'({images} of {options.min_images} collected)'
        )
    if stars < options.min_stars:
        missing.append(
            f'{counted(options.min_stars - stars, "more star")} '
            f'({stars} of {options.min_stars} collected)'
        )
    if missing:
        refused = sum(ensemble.refused.values())
        also = f'; {counted(refused, "image")} refused' if refused else ''
        more = 'take more images'
        if stars < options.min_stars:
            more += ', or find fainter stars (magnitude_limit, catalog)'
        words = f'{" and ".join(missing)} needed{also}; {more}'
        raise TooFewObservations(f'too few observations: {words}')
