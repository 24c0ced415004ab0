# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Photographs: JPEG, PNG, TIFF, FITS and camera raw, with the facts that the files state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
from datetime import datetime
import glob
import importlib
import io
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Pixels
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import IngestError, needing
from starcal_ros.formats.images.image_files import (
    content_of,
    decoded,
    FITS_ENDINGS,
    MOST_VALUES,
    number,
    read_fits,
)
from starcal_ros.formats.images.time_systems import Card, middle_of_exposure, TimeError

_RAW = ('.dng', '.cr2', '.cr3', '.nef', '.arw', '.orf', '.rw2', '.raf', '.pef')
ENDINGS = ('.jpg', '.jpeg', '.png', '.tif', '.tiff', '.bmp', *_RAW, *FITS_ENDINGS)
_DIAGONAL_35_MM = 43.2666  # of 36 mm x 24 mm
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit, Exif 2.32
_EXIF, _GPS = 0x8769, 0x8825
_FOCAL_LENGTH = 0x920A
_GREEN = 1
_SAME_STAMP_NS = NANOSECONDS_PER_SECOND  # file times are often equal; stamps must differ


@dataclass(frozen=True)
class Photograph:
    """
    Facts that a file states about its image.

    ``time_ns`` middle of the exposure; ``dated`` False where it is the time of the file, and
    ``utc`` False where its time zone is not known.  ``focal_px`` NaN where it is not stated.
    ``site`` latitude, longitude (degrees) and height (m), or None.  ``camera`` names camera, lens
    and focal length, empty where the file does not.
    """

    path: Path
    time_ns: int
    dated: bool
    utc: bool
    width: int
    height: int
    focal_px: float = math.nan
    site: tuple[float, float, float] | None = None
    camera: str = ''


def image_paths(paths: Iterable[Path]) -> list[Path]:
    """Image files of paths, folders and patterns; empty where there are none."""
    found: list[Path] = []
    for path in paths:
        if glob.has_magic(str(path)) and not path.exists():
            found += [Path(name) for name in sorted(glob.glob(str(path)))]
        elif path.is_dir():
            found += sorted(path.iterdir())
        else:
            found.append(path)
    return [path for path in found if path.name.lower().endswith(ENDINGS)]


def look_at(path: Path, focal_length_mm: float = 0.0, pixel_um: float = 0.0) -> Photograph:
    """Facts of a file; a given length or pixel size replaces its own.  Raises IngestError."""
    if path.name.lower().endswith(FITS_ENDINGS):
        values, header = read_fits(path, '')
        stated = _of_fits(path, values, header)
        stated_mm, stated_um = number(header, 'FOCALLEN'), number(header, 'PIXSIZE1', 'XPIXSZ')
    else:
        is_raw = path.name.lower().endswith(_RAW)
        tags, gps, width, height = (_facts_of_raw if is_raw else _facts_of_picture)(path)
        if width * height > MOST_VALUES:
            raise IngestError(f'{path}: claims {width} x {height} pixels')
        stated = _of_tags(path, tags, gps, width, height)
        stated_mm, stated_um = _real(tags.get(_FOCAL_LENGTH)), _pixel_um(tags, width)
    given_px = _focal_px(focal_length_mm or stated_mm, pixel_um or stated_um)
    if math.isnan(given_px) or not (focal_length_mm or pixel_um):
        return stated
    return replace(stated, focal_px=given_px)


def in_order(photographs: Sequence[Photograph]) -> list[Photograph]:
    """By time, then name; equal stamps, as of copied files, a second apart."""
    ordered = sorted(photographs, key=lambda one: (one.time_ns, one.path.name))
    found: list[Photograph] = []
    for one in ordered:
        if found and one.time_ns <= found[-1].time_ns:
            one = replace(one, time_ns=found[-1].time_ns + _SAME_STAMP_NS)
        found.append(one)
    return found


def by_camera(photographs: Sequence[Photograph]) -> dict[str, list[Photograph]]:
    """Photographs of each camera and image size, the largest group first."""
    groups: dict[str, list[Photograph]] = {}
    for one in photographs:
        groups.setdefault(f'{one.camera} {one.width} x {one.height}'.strip(), []).append(one)
    return dict(sorted(groups.items(), key=lambda group: -len(group[1])))


def pixels_of_photograph(path: Path) -> Pixels:
    """
    Light of each pixel (height, width), as the sensor has it: not turned by the EXIF orientation.

    Green of a colour image, interpolated in one of camera raw.  The sRGB curve of 8-bit colour is
    undone into 16 bit.
    """
    if path.name.lower().endswith(_RAW):
        values = _linear(path)
    elif path.name.lower().endswith(FITS_ENDINGS):
        values = read_fits(path, '')[0]
    else:
        values = decoded(path, content_of(path))  # the EXIF orientation is not applied
    if values.ndim == 3:
        is_rendered = values.dtype == np.uint8
        values = np.ascontiguousarray(values[:, :, _GREEN])
        values = _SRGB_TO_LIGHT[values] if is_rendered else values
    if values.dtype in (np.uint8, np.uint16):
        return values
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if values.dtype.kind in 'iu' and low >= 0 and high <= 65535:
        return values.astype(np.uint16)
    scaled = (np.nan_to_num(values, nan=low) - low) * (65000.0 / max(high - low, 1e-30))
    return np.rint(scaled).astype(np.uint16)


def _srgb_to_light() -> NDArray[np.uint16]:
    """Light in 16 bit of the 8-bit values of sRGB, IEC 61966-2-1."""
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.rint(65535.0 * light).astype(np.uint16)


_SRGB_TO_LIGHT = _srgb_to_light()


_Tags = Mapping[int, Any]


def _facts_of_picture(path: Path) -> tuple[_Tags, _Tags, int, int]:
    """Tags of EXIF and GPS, width and height."""
    with needing('report', IngestError, path):
        from PIL import Image
    try:
        # Opened, not decoded: size and tags only.
        with Image.open(io.BytesIO(content_of(path))) as image:
            width, height = image.size
            exif = image.getexif()
            tags = {**dict(exif), **dict(exif.get_ifd(_EXIF))}
            gps = dict(exif.get_ifd(_GPS))
    except IngestError:
        raise
    except Exception as error:  # a damaged file makes Pillow raise anything
        raise IngestError(f'{path}: not readable: {" ".join(str(error).split())[:160]}') from error
    return tags, gps, width, height


def _facts_of_raw(path: Path) -> tuple[_Tags, _Tags, int, int]:
    """Return the same of camera raw, as far as LibRaw reads them."""
    with _raw(path) as raw:
        sizes, stated, lens = raw.sizes, raw.other, raw.lens
    taken = stated.timestamp  # the digits of the camera's clock, whatever its time zone
    tags = {
        0x829A: stated.shutter_speed,
        _FOCAL_LENGTH: stated.focal_length,
        0x9003: f'{taken:%Y:%m:%d %H:%M:%S}' if taken else '',
        0xA434: f'{lens.make} {lens.model}'.strip(),
    }
    return tags, {}, sizes.width, sizes.height


def _linear(path: Path) -> NDArray[Any]:
    """Colours (height, width, 3) of camera raw in 16 bit, linear in light, one factor for all."""
    rawpy = _rawpy(path)
    with _raw(path) as raw:
        return np.asarray(
            raw.postprocess(
                # Other algorithms follow edges, and change the shape of a star.
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,  # white is that of the camera, not of the image
                user_wb=[1.0] * 4,
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                user_flip=0,
            )
        )


@contextlib.contextmanager
def _raw(path: Path) -> Iterator[Any]:
    """An open file of camera raw; raises IngestError."""
    rawpy = _rawpy(path)
    try:
        with rawpy.imread(io.BytesIO(content_of(path))) as raw:
            yield raw
    except rawpy.LibRawError as error:
        why = os.fsdecode(*error.args[:1] or [''])
        raise IngestError(f'{path}: not readable: {why}') from error


def _rawpy(path: Path) -> Any:
    with needing('raw', IngestError, path):
        return importlib.import_module('rawpy')


def _of_tags(path: Path, tags: _Tags, gps: _Tags, width: int, height: int) -> Photograph:
    """Facts of tags of EXIF."""
    time_ns, dated, utc = _exif_time(path, tags)
    # Make, Model, BodySerialNumber, LensModel
    names = (tags.get(tag) for tag in (0x010F, 0x0110, 0xA431, 0xA434))
    words = [str(name).strip('\0 ') for name in names if name]
    focal_mm, pixel_um = _real(tags.get(_FOCAL_LENGTH)), _pixel_um(tags, width)
    if words and focal_mm > 0:
        words.append(f'{focal_mm:g} mm')
    focal_px = _focal_px(focal_mm, pixel_um)
    equivalent_mm = _real(tags.get(0xA405))  # FocalLengthIn35mmFilm; 0: unknown
    if math.isnan(focal_px) and equivalent_mm > 0:
        focal_px = math.hypot(width, height) * equivalent_mm / _DIAGONAL_35_MM
    site, camera = _exif_site(gps), ' '.join(words)
    return Photograph(path, time_ns, dated, utc, width, height, focal_px, site, camera)


def _real(value: object) -> float:
    """A number of EXIF, NaN for none: rationals may have a denominator of zero."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return math.nan


def _pixel_um(tags: Mapping[int, Any], width: int) -> float:
    """Size of a pixel by FocalPlaneXResolution, of the full image of PixelXDimension."""
    per_unit, unit_mm = _real(tags.get(0xA20E)), _UNIT_MM.get(tags.get(0xA210, 2), math.nan)
    full = _real(tags.get(0xA002, width))
    if not (per_unit > 0 and full > 0):
        return math.nan
    return 1000.0 * unit_mm / per_unit * full / width


def _focal_px(focal_mm: float, pixel_um: float) -> float:
    """Focal length in pixels; NaN where it or the size of a pixel is not known."""
    return 1000.0 * focal_mm / pixel_um if focal_mm > 0 and pixel_um > 0 else math.nan


def _exif_time(path: Path, tags: Mapping[int, Any]) -> tuple[int, bool, bool]:
    """Stamp of the middle of the exposure, and whether it has a date and a time zone."""
    exposure_s = _real(tags.get(0x829A))
    half_s = 0.5 * exposure_s if exposure_s > 0 else 0.0
    zone = str(tags.get(0x9011) or tags.get(0x9010) or '').strip('\0 ')  # OffsetTimeOriginal
    text = str(tags.get(0x9003) or tags.get(0x0132) or '').strip('\0 ')  # DateTimeOriginal
    with contextlib.suppress(ValueError, OverflowError):
        aware = datetime.strptime(f'{text} {zone or "+0000"}', '%Y:%m:%d %H:%M:%S %z')
        if aware.year >= 1990:  # a clock that was never set
            return round((aware.timestamp() + half_s) * NANOSECONDS_PER_SECOND), True, bool(zone)
    return path.stat().st_mtime_ns, False, False


def _exif_site(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    try:
        degrees = [
            sum(float(part) / 60.0**k for k, part in enumerate(gps[tag]))
            * (-1.0 if str(gps[tag - 1]).upper()[:1] in 'SW' else 1.0)
            for tag in (2, 4)  # GPSLatitude, GPSLongitude, each after its reference
        ]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    height_m = _real(gps.get(6))
    if not (abs(degrees[0]) <= 90 and abs(degrees[1]) <= 180):
        return None
    return degrees[0], degrees[1], height_m if -500 < height_m < 1e5 else 0.0


def _of_fits(path: Path, values: NDArray[Any], header: Mapping[str, Card]) -> Photograph:
    time_ns, dated = path.stat().st_mtime_ns, False
    with contextlib.suppress(TimeError, ValueError, OverflowError):
        time_ns, dated = middle_of_exposure(header, ''), True
    focal_mm, pixel_um = number(header, 'FOCALLEN'), number(header, 'PIXSIZE1', 'XPIXSZ')
    matrix = (number(header, key) for key in ('CD1_1', 'CD2_1'))
    step_deg = math.hypot(*(value for value in matrix if not math.isnan(value)))
    if not step_deg > 0:
        step_deg = abs(number(header, 'CDELT1'))
    focal_px = math.degrees(1.0 / step_deg) if step_deg > 0 else _focal_px(focal_mm, pixel_um)
    words = [str(header[key].value) for key in ('TELESCOP', 'INSTRUME') if key in header]
    height, width = values.shape[:2]
    return Photograph(path, time_ns, dated, dated, width, height, focal_px, None, ' '.join(words))
