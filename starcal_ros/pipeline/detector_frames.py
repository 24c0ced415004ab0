# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Dark frame, flat field and map of bad pixels: read, checked, and applied to images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from starcal_ros import opencv as cv2
from starcal_ros.arrays import AnyArray, Floats, Indices, Pixels
from starcal_ros.errors import ImageRefused, IngestError, OptionError
from starcal_ros.formats.image_files import read_image
from starcal_ros.records import Image
from starcal_ros.stars.frame_checks import excess_of_stars
from starcal_ros.stars.hot_pixels import hot_in_dark, HotPixels, NO_HOT_PIXELS, with_bad_pixels
from starcal_ros.stars.image_model import CentroidOptions, saturation_level
from starcal_ros.stars.pixel_noise import quantisation_step_dn

_MOST_STARS = 5  # a flat field of the twilight may show as many
_MOST_BAD = 0.5  # part of the pixels from which a map is taken to be inverted
_LEAST = 0.1  # response over the median below which a pixel is bad: its noise is ten times larger


@dataclass(frozen=True)
class DetectorFrames:
    """
    Frames of a detector, (height, width), each None where it is not given.

    ``dark`` is subtracted; ``flat`` is the response of the pixels, of median 1, NaN where they are
    blind.  ``pedestal_dn`` is the median of the dark frame, which images keep; ``hot`` are hot and
    bad pixels.
    """

    dark: Pixels | None = None
    flat: Floats | None = None
    hot: HotPixels = NO_HOT_PIXELS
    pedestal_dn: int = 0

    def corrected(self, image: Image, options: CentroidOptions) -> tuple[Image, CentroidOptions]:
        """
        Image without the dark frame, divided by the flat field, and the options to measure it.

        The raw pixels show which are saturated.  A flat field leaves them no common level: they
        get one that no other pixel reaches, and ``saturation_dn`` states it.

        Raises ImageRefused ``bad_encoding`` if the dark frame has another type of pixels.
        """
        pixels = image.pixels
        if self.dark is None and self.flat is None:
            return image, options
        full_dn = saturation_level(pixels, options, quantisation_step_dn(pixels))
        saturated = pixels >= (full_dn or np.inf)
        level, top = self._flattened(self._without_dark(pixels)), int(pixels.max())
        if self.flat is not None:
            level[saturated] = 0
            top = min(max(top, int(level.max()) + 1), np.iinfo(pixels.dtype).max)
            if full_dn:
                options = replace(options, saturation_dn=float(top))
        level[saturated | (level > top)] = top
        return Image(image.time_ns, level), options

    def _without_dark(self, pixels: Pixels) -> Pixels:
        """Pixels minus dark frame, kept positive by adding the median of the dark frame."""
        dark = self.dark
        if dark is None:
            return pixels
        if dark.dtype != pixels.dtype:
            raise ImageRefused(
                'bad_encoding', f'{pixels.dtype} image, the dark frame is {dark.dtype}'
            )
        # Clipping noise below the dark level at zero would bias the background.
        below = np.minimum(dark, dark.dtype.type(self.pedestal_dn))
        raised = cv2.add(pixels, dark.dtype.type(self.pedestal_dn) - below)
        level: Pixels = cv2.subtract(raised, dark - below)
        return level

    def _flattened(self, pixels: Pixels) -> Pixels:
        """Pixels divided by the flat field above the pedestal; blind pixels as they are."""
        if self.flat is None:
            return pixels
        signal = (pixels.astype(np.float32) - self.pedestal_dn) / np.nan_to_num(self.flat, nan=1.0)
        level = np.clip(np.rint(signal + self.pedestal_dn), 0, np.iinfo(pixels.dtype).max)
        return level.astype(np.uint8) if pixels.dtype == np.uint8 else level.astype(np.uint16)


NO_FRAMES = DetectorFrames()


def read_detector_frames(
    dark_frame: str, flat_field: str, bad_pixel_map: str, width: int, height: int
) -> DetectorFrames:
    """
    Frames by the paths of the options of these names; an empty path: none.

    Raises OptionError for a file that is missing, damaged, of another size, or not such a frame.
    """
    size = width, height
    dark = _dark(dark_frame, *size) if dark_frame else None
    flat = _flat(flat_field, *size) if flat_field else None
    hot = hot_in_dark(dark)
    if bad_pixel_map:
        hot = with_bad_pixels(hot, _bad_pixels(bad_pixel_map, *size))
    if flat is not None:
        hot = with_bad_pixels(hot, np.flatnonzero(np.isnan(flat)))
    return DetectorFrames(dark, flat, hot, 0 if dark is None else int(np.median(dark)))


def _dark(path: str, width: int, height: int) -> Pixels:
    values = _read('dark_frame', path, width, height)
    if values.dtype not in (np.uint8, np.uint16):
        raise OptionError(
            f'dark_frame: {path} is {values.dtype}, expected unsigned 8 or 16 bit, one channel of'
            f' {width} x {height}'
        )
    return values


def _flat(path: str, width: int, height: int) -> Floats:
    """Response of the pixels, median 1; NaN where it is under a tenth of that."""
    values = _read('flat_field', path, width, height).astype(np.float64)
    with np.errstate(all='ignore'):
        middle = float(np.nanmedian(values))
        response = values / middle
    if not middle > 0:
        raise OptionError(f'flat_field: {path}: the median is {middle:g}, not positive')
    stars = excess_of_stars(response)
    if stars > _MOST_STARS:
        raise OptionError(
            f'flat_field: {path} shows {stars} stars: it is a frame of the sky; give a frame of an'
            ' evenly lit field, without its bias'
        )
    response[~(response >= _LEAST)] = np.nan
    return np.asarray(response)


def _bad_pixels(path: str, width: int, height: int) -> Indices:
    """Flat indices (k,) of the pixels of a map that are not 0."""
    bad = np.flatnonzero(_read('bad_pixel_map', path, width, height))
    if len(bad) > _MOST_BAD * width * height:
        raise OptionError(
            f'bad_pixel_map: {path} marks {len(bad) / (width * height):.0%} of the pixels as bad:'
            ' write 0 for good pixels, any other value for bad ones'
        )
    return bad


def _read(name: str, path: str, width: int, height: int) -> AnyArray:
    expected = f'expected one channel of {width} x {height}'
    try:
        values = read_image(Path(path.removeprefix('file://')))
    except IngestError as error:
        raise OptionError(f'{name}: {error}; {expected}') from error
    if values.shape != (height, width):
        raise OptionError(f'{name}: {path} is of shape {values.shape}, {expected}')
    return values
