# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Options of a calibration, and whether an ensemble is enough for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import ALL_PARAMETER_NAMES, parameter_names
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.problem import METHODS
from starcal_ros.lens import COEFFICIENTS
from starcal_ros.options import option
from starcal_ros.records import Ensemble

_USUAL_TRACKER_ARCSEC = 10.0  # until the scatter of the images replaces it


@dataclass(frozen=True)
class CalibrationOptions:
    """What is estimated, and how."""

    method: str = option(
        'hierarchical', 'how the attitudes of the images are treated', choices=METHODS
    )
    estimate: tuple[str, ...] = option(
        ('fx', 'skew', 'fy', 'cx', 'cy', 'distortion'),
        'camera parameters that are estimated; the others are held at the prior; distortion: all'
        ' coefficients of the lens model',
        choices=(*ALL_PARAMETER_NAMES, 'distortion'),
    )
    star_tracker_sigma_arcsec: tuple[float, ...] = option(
        (0.0, 0.0, 0.0),
        '1-sigma of the star tracker attitude about its x, y, z axes, arcsec; zeros: estimated'
        ' from the scatter of the images',
        low=0.0,
        high=3600.0,
        length=3,
    )
    min_images: int = option(
        3, 'fewest images from which a calibration is made', low=1, high=100000
    )
    min_stars: int = option(
        60, 'fewest star observations from which a calibration is made', low=10, high=1000000
    )
    max_images: int = option(
        400, 'most images kept; beyond it those that add least information go', low=3, high=100000
    )
    outlier_sigma: float = option(
        4.5,
        'length of a residual, in its sigma, from which a star is left out',
        low=3.0,
        high=20.0,
    )
    prior_sigma: tuple[float, ...] = option(
        (0.0,),
        '1-sigma of the prior of fx, skew, fy, cx, cy (px) and of the coefficients of the lens'
        ' model, or one number for all; 0: of one that is estimated, nothing is known; of one that'
        ' is held, it is taken as exact',
        low=0.0,
    )
    star_tracker_mounting_sigma_arcsec: float = option(
        300.0,
        '1-sigma of each angle of the mountings of several star trackers among each other, as'
        ' more_alignments and prior_alignment have them, arcsec',
        low=1e-3,
        high=648000.0,
    )
    principal_point_prior: float = option(
        0.03,
        '1-sigma of the prior of cx and cy where prior_sigma gives none, as a fraction of the'
        ' longer side of the image; 0: none',
        low=0.0,
        high=1.0,
    )
    variance_components: bool = option(
        True, 'estimate the sigmas of centroids and star tracker again from the residuals'
    )
    velocity_sigma_m_s: float = option(
        -1.0,
        "1-sigma of each component of the observer's velocity, m/s; -1: by the observations, 10"
        ' with a velocity, 0 on the ground, and 8000 (an orbit about the Earth) without one',
        low=-1.0,
        high=3e5,
    )
    shutter: str = option(
        'unknown',
        'global: all rows are exposed at once; rolling: one after the other over readout_s, the'
        ' middle one at the stamp; unknown: the time is estimated, 20 ms 1-sigma. The star tracker'
        ' gives the rate, images without one are taken as still',
        choices=('global', 'rolling', 'unknown'),
    )
    readout_s: float = option(
        0.0,
        'time from the first to the last row of a rolling shutter, by the data sheet (to 1 %), s;'
        ' negative: the last row comes first',
        low=-10.0,
        high=10.0,
    )
    stamp_sigma_s: float = option(
        0.005,
        '1-sigma of a constant offset of the image stamps against the attitudes, s',
        low=0.0,
        high=10.0,
    )
    star_tracker_slow_arcsec: float = option(
        0.0,
        '1-sigma of star-tracker errors that last longer than an image, arcsec; 0: not known, as'
        ' large as the noise until the images show otherwise',
        low=0.0,
        high=3600.0,
    )
    focal_temperature_order: int = option(
        0, 'degree of the polynomial of focal length in temperature; 0: none', low=0, high=2
    )
    alignment_temperature: bool = option(
        False, 'alignment linear in temperature; not with the method per_image'
    )
    reference_temperature_degc: float = option(
        20.0,
        'temperature at which camera and alignment are reported where they change with it, degC',
        low=-273.15,
        high=1000.0,
    )


def check_options(options: CalibrationOptions, model: str) -> None:
    """
    Raise `OptionError` for options that do not go together, or not with a lens model.

    Raises
    ------
    OptionError
        Naming the option.
    """
    if options.alignment_temperature and options.method == 'per_image':
        # Its mean of the images' alignments has no place for a slope: `hierarchical` with a loose
        # star tracker is the same estimate with one.
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
    """Whether a star tracker sigma is assumed, in place of the scatter of the images alone."""
    return any(options.star_tracker_sigma_arcsec)


def assumed_tracker_sigma_rad(options: CalibrationOptions) -> Floats:
    """1-sigma (3,) of the star tracker at the start of an estimate."""
    if not tracker_sigma_is_given(options):
        return np.full(3, _USUAL_TRACKER_ARCSEC * ARCSECOND_RAD)
    return np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD


def estimated_parameters(options: CalibrationOptions, model: str) -> tuple[str, ...]:
    """Names of the camera parameters that ``estimate`` asks for, of a lens model."""
    return tuple(
        name
        for asked in options.estimate
        for name in (COEFFICIENTS[model] if asked == 'distortion' else (asked,))
    )


def check_enough(ensemble: Ensemble, options: CalibrationOptions) -> None:
    """
    Raise `TooFewObservations` that says how many images or stars are missing.

    Raises
    ------
    TooFewObservations
        A sentence for a person.
    """
    images, stars = len(ensemble.images), ensemble.star_count
    missing = []
    if images < options.min_images:
        missing.append(
            f'{options.min_images - images} more images are needed '
            f'({images} of {options.min_images} collected)'
        )
    if stars < options.min_stars:
        missing.append(
            f'{options.min_stars - stars} more stars are needed '
            f'({stars} of {options.min_stars} collected)'
        )
    if missing:
        refused = sum(ensemble.refused.values())
        also = f'; {refused} images were refused' if refused else ''
        raise TooFewObservations('too few observations: ' + ' and '.join(missing) + also)
