# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Dark frame, flat field and bad pixels of a detector."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Indices, Pixels
from starcal_ros.errors import IngestError, OptionError
from starcal_ros.formats.image_files import read_image
from starcal_ros.records import Image
from starcal_ros.stars.detection import detect, measure_background
from starcal_ros.stars.hot_pixels import HotPixels

_UNIT_DN = 30000  # of a response of 1, where it is searched for stars
_STAR_SIGMA = 8.0  # of a star in a flat field: five megapixels of noise have none
_MOST_STARS = 5  # of a flat field of the twilight
_MOST_BAD = 0.5  # part of the pixels from which a map is taken to be inverted
_LEAST = 0.1  # response over the median below which a pixel is bad: its noise is ten times larger


def read_dark(path: str, width: int, height: int) -> Pixels | None:
    """Pixels (height, width) of a dark frame; None without a path; raises as `read_flat`."""
    if not path:
        return None
    values = _read('dark_frame', path, width, height)
    if values.dtype not in (np.uint8, np.uint16):
        raise OptionError(
            f'dark_frame: {path} is {values.dtype}, expected unsigned 8 or 16 bit, one channel of'
            f' {width} x {height}'
        )
    return values


def read_flat(path: str, width: int, height: int) -> Floats | None:
    """
    Response (height, width) of the pixels, median 1; NaN where it is under a tenth of that.

    None without a path. Raises OptionError when the file is missing, damaged or of another size,
    or holds no positive number or stars.
    """
    if not path:
        return None
    values = _read('flat_field', path, width, height).astype(np.float64)
    with np.errstate(all='ignore'):
        middle = float(np.nanmedian(values))
        response = values / middle
    if not middle > 0:
        raise OptionError(f'flat_field: {path}: the median is {middle:g}, not positive')
    stars = _excess_of_stars(response)
    if stars > _MOST_STARS:
        raise OptionError(
            f'flat_field: {path} shows {stars} stars: it is a frame of the sky; give a frame of an'
            ' evenly lit field, without its bias'
        )
    response[~(response >= _LEAST)] = np.nan
    return np.asarray(response)


def read_bad_pixels(path: str, width: int, height: int) -> Indices:
    """Flat indices (k,) of the pixels of a map that are not 0; raises as `read_flat`."""
    if not path:
        return np.empty(0, np.int64)
    bad = np.flatnonzero(_read('bad_pixel_map', path, width, height))
    if len(bad) > _MOST_BAD * width * height:
        raise OptionError(
            f'bad_pixel_map: {path} marks {len(bad) / (width * height):.0%} of the pixels as bad:'
            ' write 0 for good pixels, any other value for bad ones'
        )
    return bad


def _excess_of_stars(response: Floats) -> int:
    """
    Number of star-like bright spots of a response beyond that of dark ones.

    Pixels of a flat field are as often dark as bright, and its dust is dark; stars are bright.
    """
    level = np.nan_to_num(response, nan=1.0, posinf=1.0, neginf=1.0)
    # Columns and rows of another gain have edges, whose maxima are no stars either.
    level = level / np.maximum(np.median(level, axis=0), _LEAST)
    level = level / np.maximum(np.median(level, axis=1), _LEAST)[:, None] * _UNIT_DN
    bright, dark = (
        detect(pixels, measure_background(pixels), _STAR_SIGMA)
        for pixels in (
            np.clip(np.rint(values), 0, 2 * _UNIT_DN).astype(np.uint16)
            for values in (level, 2 * _UNIT_DN - level)
        )
    )
    return len(bright.snr) - len(dark.snr)


def with_bad_pixels(hot: HotPixels, bad: Indices, flat: Floats | None) -> HotPixels:
    """Hot pixels, bad pixels and those without response in the flat field, together."""
    blind = np.empty(0, np.int64) if flat is None else np.flatnonzero(np.isnan(flat))
    index = np.union1d(np.union1d(hot.index, bad), blind)
    return dataclasses.replace(hot, index=index) if len(index) else hot


def flattened(image: Image, flat: Floats | None, pedestal_dn: int) -> Image:
    """
    Image divided by the flat field above a pedestal; of blind pixels as it is.

    The brightest pixels stay at the peak of the image, so that saturated ones are still found.
    """
    if flat is None:
        return image
    pixels = image.pixels
    peak = int(pixels.max())
    signal = (pixels.astype(np.float32) - pedestal_dn) / np.nan_to_num(flat, nan=1.0)
    level = np.clip(np.rint(signal + pedestal_dn), 0, peak)
    level[pixels == peak] = peak
    cast = level.astype(np.uint8) if pixels.dtype == np.uint8 else level.astype(np.uint16)
    return Image(image.time_ns, cast)


def _read(name: str, path: str, width: int, height: int) -> NDArray[Any]:
    expected = f'expected one channel of {width} x {height}'
    try:
        values, _ = read_image(Path(path.removeprefix('file://')))
    except IngestError as error:
        raise OptionError(f'{name}: {error}; {expected}') from error
    if values.shape != (height, width):
        raise OptionError(f'{name}: {path} is of shape {values.shape}, {expected}')
    return values
