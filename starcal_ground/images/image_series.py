# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Series of image files that become messages: FITS, TIFF or PNG, with times and one scale.

A ROS image has 8 or 16 bit per pixel.  Integers that fit are kept; other values, mostly floating
point, are mapped to 16 bit with one recorded scale for all images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import itertools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcal_ground.fits_images import FileImage, read_fits
from starcal_ground.fits_keywords import value_of
from starcal_ground.images import fits_facts
from starcal_ground.images.fits_facts import number_of
from starcal_ground.mirror import MIRRORED, mirrored
from starcal_ros.arrays import Pixels
from starcal_ros.errors import IngestError, OptionError
from starcal_ros.formats.image_files import Card, check_shape, is_fits, read_image
from starcal_ros.formats.messages.sensor_messages import CHANNELS, of_mosaic, plane

_ROWS = 256  # mapped at a time: an image in double precision can exceed the memory
_FULL = 65000  # largest 16-bit value written: the end of the range means saturation


@dataclass(frozen=True)
class FileFacts:
    """
    Facts of image files that their user states.

    ``times`` holds stamps of the middle of the exposure by file name, which replace those of the
    files; ``flip`` is a key of `MIRRORED` if the files are mirrored images, else empty.

    Raises OptionError for another flip.
    """

    times: Mapping[str, int] | None = None
    flip: str = ''

    def __post_init__(self) -> None:
        """Check the flip, which a program may state."""
        if self.flip and self.flip not in MIRRORED:
            raise OptionError(f'flip: {self.flip!r} is not one of {", ".join(MIRRORED)}')

    @property
    def pixels_of(self) -> str:
        """Words of the provenance on the flip; empty without one."""
        return f'{MIRRORED[self.flip]} (--flip)' if self.flip else ''

    def time_ns(self, path: Path) -> int | None:
        """Stamp of a file, None if no times are stated; raises IngestError if its own is not."""
        if self.times is None:
            return None
        if path.name not in self.times:
            raise IngestError(f'{path}: not in the table of --times')
        return self.times[path.name]


@dataclass(frozen=True)
class ImageOptions(FileFacts):
    """
    How the files are read.

    ``time_key`` is the FITS keyword of the middle of the exposure (empty: the standard keywords),
    ``hdu`` the number or name of a FITS extension (empty: the first image), ``channel`` red, green
    or blue of a colour image, ``bayer`` the pattern of a mosaic, ``value_range`` the range mapped
    to 16 bit (None: that of the images).
    """

    time_key: str = ''
    hdu: str = ''
    channel: str = ''
    bayer: str = ''
    value_range: tuple[float, float] | None = None
    temperature_key: str = ''


@dataclass(frozen=True)
class ImageFile:
    """
    An image file: stamp of the middle of the exposure, size, range and noise of its pixels.

    ``saturation`` is the FITS keyword SATURATE, NaN without one; ``temperature_degc`` likewise.
    ``pixels_of`` says which pixels of the file they are, empty for all.
    """

    path: Path
    time_ns: int
    width: int
    height: int
    dtype: np.dtype[Any]
    low: float
    high: float
    noise: float
    saturation: float
    temperature_degc: float
    pixels_of: str = ''


@dataclass(frozen=True)
class PixelScale:
    """Mapping of pixel values to 16 bit, ``dn = round((value - offset) / step)``; or none."""

    offset: float
    step: float
    dtype: type[np.uint8] | type[np.uint16]

    @property
    def is_none(self) -> bool:
        """True if pixel values are not scaled."""
        return (self.offset, self.step) == (0.0, 1.0)

    def to_dn(self, values: NDArray[Any]) -> Pixels:
        """Pixels of values; not-a-number becomes the median of the image."""
        if self.is_none and values.dtype.kind in 'ui':
            return self._cast(values)
        middle = float(np.nanmedian(values)) if np.isnan(values).any() else 0.0
        pixels = self._cast(np.zeros(values.shape, self.dtype))
        for top in range(0, len(values), _ROWS):
            known = np.nan_to_num(values[top : top + _ROWS], nan=middle)
            dn = np.rint((known - self.offset) / self.step)
            pixels[top : top + _ROWS] = np.clip(dn, 0, np.iinfo(self.dtype).max)
        return pixels

    def _cast(self, values: NDArray[Any]) -> Pixels:
        return values.astype(np.uint8) if self.dtype is np.uint8 else values.astype(np.uint16)


def look(path: Path, options: ImageOptions) -> ImageFile:
    """Stamp, size and range of an image file; raises IngestError with the remedy."""
    image = _of_options(path, options)
    values, header = image.values, image.header
    finite = np.isfinite(values)
    if not finite.any():
        raise IngestError(f'{path}: no pixel is a finite number')
    some = values.flat[int(finite.argmax())]
    steps = np.abs(np.diff(values[:: max(1, len(values) // 200)].astype(np.float64), axis=1))
    height, width = values.shape
    return ImageFile(
        path,
        _time_ns(path, header, options),
        width,
        height,
        values.dtype,
        float(values.min(where=finite, initial=some)),
        float(values.max(where=finite, initial=some)),
        # The median step between neighbours is 0.954 sigma for white noise.
        float(np.nanmedian(steps)) / 0.954,
        number_of(header, 'saturation'),
        value_of(header, options.temperature_key.upper()),
        image.pixels_of,
    )


def pixels_of(path: Path, options: ImageOptions, scale: PixelScale) -> Pixels:
    """Pixels (height, width) of an image file, in 8 or 16 bit."""
    pixels = scale.to_dn(_of_options(path, options).values)
    pixels.setflags(write=False)
    return pixels


def common_scale(files: Sequence[ImageFile], options: ImageOptions) -> PixelScale:
    """The scale of all images; none if whole numbers fit 16 bit.  Raises IngestError."""
    kinds = [file.dtype for file in files] if options.value_range is None else []
    low, high = options.value_range or (
        min(file.low for file in files),
        max(file.high for file in files),
    )
    scale = scale_of(kinds, low, high)
    if not scale.step > 0:
        raise IngestError(f'--value-range: {low:g} to {high:g} is empty')
    return scale


def scale_of(kinds: Sequence[np.dtype[Any]], low: float, high: float) -> PixelScale:
    """The scale of values of some types from ``low`` to ``high``; without a type to 16 bit."""
    if kinds and all(kind.kind in 'ui' for kind in kinds):
        if low >= 0 and high <= 65535:
            eight = all(kind.itemsize == 1 for kind in kinds)
            return PixelScale(0.0, 1.0, np.uint8 if eight else np.uint16)
        if high - low <= _FULL:
            return PixelScale(low, 1.0, np.uint16)
    return PixelScale(low, (high - low) / _FULL, np.uint16)


def check_alike(files: Sequence[ImageFile]) -> None:
    """Check that images have one size and different stamps; raises IngestError."""
    first = files[0]
    for file in files:
        if (file.width, file.height) != (first.width, first.height):
            raise IngestError(
                f'{file.path}: {file.width} x {file.height} pixels, {first.path} has '
                f'{first.width} x {first.height}: import the images of one camera and mode'
            )
    by_time = sorted(files, key=lambda file: file.time_ns)
    for before, after in itertools.pairwise(by_time):
        if before.time_ns == after.time_ns:
            raise IngestError(f'{after.path}: has the time of {before.path}')


def _of_options(path: Path, options: ImageOptions) -> FileImage:
    """One channel of an image file, by the mosaic of the options or else of its header."""
    image = read_fits(path, options.hdu) if is_fits(path) else FileImage(read_image(path), {})
    values, channel = image.values, options.channel
    if (values.ndim == 3 or options.bayer) and channel not in CHANNELS:
        raise IngestError(f'{path}: a colour image: choose --channel red, green or blue')
    if values.ndim == 3:
        values = plane(values, 'rgb', channel)
    elif options.bayer:
        values = of_mosaic(values, options.bayer.lower(), channel)
    elif image.mosaic:
        if not channel:
            raise IngestError(
                f'{path}: a mosaic, {image.mosaic.upper()} by its header: choose --channel red,'
                ' green or blue'
            )
        values = of_mosaic(values, image.mosaic, channel)
    check_shape(path, values.shape)
    pixels_of = '; '.join(filter(None, [image.pixels_of, options.pixels_of]))
    return image._replace(values=mirrored(values, options.flip), pixels_of=pixels_of)


def _time_ns(path: Path, header: Mapping[str, Card], options: ImageOptions) -> int:
    if (time_ns := options.time_ns(path)) is not None:
        return time_ns
    if not header:
        raise IngestError(f'{path}: has no time: give --times FILE with columns file, time_utc')
    try:
        return fits_facts.middle_of_exposure(header, options.time_key)
    except (ValueError, OverflowError) as error:
        raise IngestError(f'{path}: {error}') from error
