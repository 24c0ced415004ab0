# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images in FITS, TIFF and PNG files: times, pixels in 8 or 16 bit, and their scale.

A ROS image has 8 or 16 bit per pixel.  Integers that fit are kept; other values, mostly floating
point, are mapped to 16 bit with one recorded scale for all images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass
import itertools
import math
import os
from pathlib import Path
from typing import Any
import warnings

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Pixels
from starcal_ros.errors import errors_as, IngestError, needing
from starcal_ros.formats.file_kinds import FITS, kind_of
from starcal_ros.formats.images.file_header import (
    has_surplus,
    is_cut_jpeg,
    png_header,
    tiff_header,
)
from starcal_ros.formats.images.time_systems import Card, middle_of_exposure, TimeError
from starcal_ros.formats.messages.image_messages import CHANNELS, of_mosaic, plane
from starcal_ros.untrusted import regular_file

_RGB, _GREY = 3, 2
MOST_VALUES = 2**27  # per image, all colours; the nodes have the same limit
MOST_BYTES = 2**29  # of a file that is decoded as a whole
_ROWS = 256  # mapped at a time: an image in double precision can exceed the memory
_FULL = 65000  # of 16 bit; the end of the range means saturation


@dataclass(frozen=True)
class ImageOptions:
    """
    How the files are read.

    ``time_key`` is the FITS keyword of the middle of the exposure (empty: the standard keywords);
    ``times`` holds stamps by file name, which replace it.  ``hdu`` is the number or name of a FITS
    extension (empty: the first image), ``channel`` red, green or blue of a colour image, ``bayer``
    the pattern of a mosaic, ``value_range`` the range mapped to 16 bit (None: that of the images).
    """

    time_key: str = ''
    times: Mapping[str, int] | None = None
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


@dataclass(frozen=True)
class Scale:
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
    values, header = _read(path, options)
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
        number(header, 'SATURATE'),
        number(header, options.temperature_key),
    )


def pixels_of(path: Path, options: ImageOptions, scale: Scale) -> Pixels:
    """Pixels (height, width) of an image file, in 8 or 16 bit."""
    pixels = scale.to_dn(_read(path, options)[0])
    pixels.setflags(write=False)
    return pixels


def common_scale(files: Sequence[ImageFile], options: ImageOptions) -> Scale:
    """The scale of all images; none if whole numbers fit 16 bit.  Raises IngestError."""
    kinds = {file.dtype.kind for file in files}
    low, high = min(file.low for file in files), max(file.high for file in files)
    whole = kinds <= {'u', 'i'}
    if options.value_range is None and whole and low >= 0 and high <= 65535:
        eight = all(file.dtype.itemsize == 1 for file in files)
        return Scale(0.0, 1.0, np.uint8 if eight else np.uint16)
    if options.value_range is None and whole and high - low <= _FULL:
        return Scale(low, 1.0, np.uint16)
    low, high = options.value_range or (low, high)
    if not low < high:
        raise IngestError(f'--value-range: {low:g} to {high:g} is empty')
    return Scale(low, (high - low) / _FULL, np.uint16)


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


def _read(path: Path, options: ImageOptions) -> tuple[NDArray[Any], Mapping[str, Card]]:
    if is_fits(path):
        values, header = read_fits(path, options.hdu)
    else:
        content = content_of(path)
        if not (png_header(content) or tiff_header(content)):
            raise IngestError(f'{path}: not an image in FITS, TIFF or PNG')
        values, header = decoded(path, content), {}
        values = values[:, :, 2::-1] if values.ndim == _RGB else values  # BGR, with alpha last
    is_colour = values.ndim == _RGB and values.shape[2] == _RGB
    if (is_colour or options.bayer) and options.channel not in CHANNELS:
        raise IngestError(f'{path}: a colour image: choose --channel red, green or blue')
    if is_colour:
        values = plane(values, 'rgb', options.channel)
    elif options.bayer:
        values = of_mosaic(values, options.bayer.lower(), options.channel)
    if values.ndim != _GREY or min(values.shape) < 2:
        raise IngestError(
            f'{path}: array of shape {values.shape}, neither an image nor three colour planes: '
            'write each image to its own file'
        )
    return values, header


def is_fits(path: Path) -> bool:
    """True if a file is FITS by its content, compressed or not; raises IngestError."""
    with errors_as(IngestError, path):
        return kind_of(path) is FITS


def read_fits(path: Path, hdu: str) -> tuple[NDArray[Any], Mapping[str, Card]]:
    """Values and cards of the image ``hdu``, or the first, of a FITS file; raises IngestError."""
    with needing('mission', IngestError, path):
        from astropy.io import fits
    try:
        # Not mapped to memory: scaled data cannot be, and files are read one at a time.
        with (
            _truncation_is_an_error(),
            regular_file(path) as file,
            fits.open(file, memmap=False, uint=True) as units,
        ):
            if hdu:
                unit = units[int(hdu) if hdu.lstrip('-').isdigit() else hdu]
            else:
                unit = next(
                    (u for u in units if u.is_image and u.header.get('NAXIS', 0) >= 2), None
                )
            if unit is None or not unit.is_image:
                raise IngestError(f'{path}: no image in the FITS file')
            sides = [unit.header.get(f'NAXIS{k + 1}', 0) for k in range(unit.header['NAXIS'])]
            # A compressed image of a few kilobytes can claim gigabytes of pixels.
            if math.prod(sides) > MOST_VALUES or unit.data is None:
                raise IngestError(f'{path}: no image of up to {MOST_VALUES} values')
            # The time may be in the primary header, the image in an extension.
            header = {**_cards(units[0].header), **_cards(unit.header)}
            values = np.asarray(unit.data)
    except (IngestError, MemoryError):
        raise
    except Exception as error:  # astropy raises any exception on a damaged file
        words = ' '.join(str(error).split())[:160]
        raise IngestError(f'{path}: not readable as FITS: {words}') from error
    values = values.squeeze()
    if values.ndim == _RGB and values.shape[0] == _RGB:
        values = np.moveaxis(values, 0, -1)  # a cube of three planes
    return values.astype(values.dtype.newbyteorder('=')), header


def _cards(header: Any) -> dict[str, Card]:
    """Cards of a header of astropy; the first of duplicate keywords counts."""
    found: dict[str, Card] = {}
    for card in header.cards:
        try:
            value = Card(card.value, card.comment)
        except Exception:  # astropy cannot parse it: keep the text, fail only where it is used
            value = Card(str(card.image)[10:].strip())
        found.setdefault(card.keyword, value)
    return found


@contextlib.contextmanager
def _truncation_is_an_error() -> Iterator[None]:
    """Raise on astropy's warning of a truncated file, and drop its other warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        warnings.filterwarnings('error', message='File may have been truncated')
        yield


def read_values(path: Path) -> NDArray[Any]:
    """Unscaled values (height, width) of a single-channel file; raises IngestError."""
    return _read(path, ImageOptions())[0]


def content_of(path: Path, first_bytes: int = MOST_BYTES) -> bytes:
    """Content of an image file, or its first bytes; raises IngestError if it cannot be read."""
    with errors_as(IngestError, path), regular_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > MOST_BYTES:
            raise ValueError(f'larger than {MOST_BYTES // 2**20} MB')
        return file.read(min(size, first_bytes))


def decoded(path: Path, content: bytes) -> NDArray[Any]:
    """
    Values of an image file without EXIF rotation, colour as BGR; raises IngestError.

    The size in the header of a PNG or TIFF is checked before anything is decoded.
    """
    header = png_header(content) or tiff_header(content)
    if header and header.width * header.height * header.channels > MOST_VALUES:
        raise IngestError(f'{path}: its header claims {header.width} x {header.height} pixels')
    if header and png_header(content) and has_surplus(content, header):
        raise IngestError(f'{path}: inflates to far more than its pixels')
    values = None
    if not is_cut_jpeg(content):
        with contextlib.suppress(cv2.error):
            values = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise IngestError(f'{path}: damaged, or in a format that OpenCV cannot read')
    return np.asarray(values)


def _time_ns(path: Path, header: Mapping[str, Card], options: ImageOptions) -> int:
    if options.times is not None:
        if path.name not in options.times:
            raise IngestError(f'{path}: not in the table of --times')
        return options.times[path.name]
    if not header:
        raise IngestError(f'{path}: has no time: give --times FILE with columns file, time_utc')
    try:
        return middle_of_exposure(header, options.time_key)
    except (TimeError, ValueError, OverflowError) as error:
        raise IngestError(f'{path}: {error}') from error


def number(header: Mapping[str, Card], *keys: str) -> float:
    """Value of the first keyword with a number; NaN if there is none."""
    values = (header[key].value for key in keys if key in header)
    return next((float(one) for one in values if isinstance(one, (int, float))), math.nan)
