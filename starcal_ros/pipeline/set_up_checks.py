# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Checks for implausible options; each error names the likely mistake and its remedy.

Each check raises `OptionError` in one line, wherever a setup is loaded: by a node at its start,
by `starcal calibrate`, `inspect` and `diagnose`.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.sky.astrometry import SiteOptions

_LONGEST = 500.0  # focal length by the width: a field of 0.1 degrees
# No star tracker is as good as 0.01 arcsec: 0.001 rad are 206 arcsec, 0.01 degrees 36 arcsec.
_RADIANS_BELOW, _DEGREES_BELOW = 1e-3, 1e-2
_FEWEST_STARS = 2.0  # in a mean field: the densest fields have three times as many


def check_tracker_sigma(sigma_arcsec: Sequence[float]) -> None:
    """Raise `OptionError` for a star tracker sigma in radians or degrees."""
    largest = max(sigma_arcsec)
    if not 0.0 < largest < _DEGREES_BELOW:
        return
    unit, arcsec = ('radians', 1.0 / ARCSECOND_RAD)
    if largest >= _RADIANS_BELOW:
        unit, arcsec = ('degrees', 3600.0)
    converted = ', '.join(f'{sigma * arcsec:.3g}' for sigma in sigma_arcsec)
    raise OptionError(
        f'star_tracker_sigma_arcsec: {list(sigma_arcsec)} looks like {unit}: in arcseconds it is'
        f' [{converted}]'
    )


def check_site(site: SiteOptions) -> None:
    """Raise `OptionError` for a camera on the ground without a site."""
    if site.observer == 'ground' and site.latitude_deg == site.longitude_deg == 0.0:
        raise OptionError(
            'observer: ground needs the site: set latitude_deg, longitude_deg (east positive) and'
            ' height_m'
        )


def check_field_of_stars(stars: int, magnitude_limit: float, camera: CameraModel) -> None:
    """Raise `OptionError` for a magnitude limit that leaves a camera without stars."""
    fx, _, fy = (float(value) for value in camera.intrinsics[:3])
    field_sr = min(camera.width * camera.height / (fx * fy), 4.0 * math.pi)
    in_field = stars * field_sr / (4.0 * math.pi)
    if in_field < _FEWEST_STARS:
        raise OptionError(
            f'magnitude_limit: {magnitude_limit:g} leaves {stars} stars in the sky, {in_field:.2g}'
            ' in a mean field of the camera; raise it'
        )


def check_prior_camera(camera: CameraModel, location: str) -> None:
    """Raise `OptionError` for an implausible camera that `camera.check_plausible` accepts."""
    width, height = camera.width, camera.height
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics[:5])
    if not 0.5 < fx / fy < 2.0:
        raise OptionError(f'{location}: fx = {fx:g} and fy = {fy:g} px differ by a factor of two')
    width_deg = math.degrees(2 * math.atan(width / 2 / fx))
    if fx > _LONGEST * width:
        raise OptionError(
            f'{location}: focal length of {fx:g} px makes a field of {width_deg:.2g} degrees:'
            ' it seems to be in micrometres; divide it by the size of a pixel'
        )
    if not (-0.5 * width < cx < 1.5 * width and -0.5 * height < cy < 1.5 * height):
        raise OptionError(
            f'{location}: principal point ({cx:g}, {cy:g}) px is far outside the image of {width}'
            f' x {height}'
        )
    if 0 < abs(cx) < 0.05 * width and 0 < abs(cy) < 0.05 * height:
        raise OptionError(
            f'{location}: principal point ({cx:g}, {cy:g}) is in the first corner of an image of'
            f' {width} x {height}: give it in pixels, not in metres or millimetres'
        )
