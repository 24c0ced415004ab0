# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Photographs, JPEG, PNG, TIFF, FITS and camera raw: facts that they state, and their light."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
from datetime import datetime, timezone
import importlib
import io
import itertools
import math
import os
from pathlib import Path
import re
from typing import Any
import warnings

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ground.file_kinds import (
    FileKind,
    FITS,
    IMAGES_READ,
    JPEG,
    kind_of,
    matching,
    PNG,
    RAW,
    UNKNOWN,
)
from starcal_ground.fits_images import FileImage, read_fits
from starcal_ground.fits_keywords import FACTS
from starcal_ground.images import fits_facts
from starcal_ground.images.fits_facts import FocalLength, Moment, number_of
from starcal_ground.images.image_series import FileFacts, scale_of
from starcal_ground.mirror import mirrored
from starcal_ros.arrays import Pixels
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import errors_as, IngestError, needing
from starcal_ros.formats.image_files import content_of, decoded, in_rgb, MOST_VALUES
from starcal_ros.formats.messages.sensor_messages import CHANNELS
from starcal_ros.text import counted

# These names mark images whose content does not, as damaged ones; HEIC of telephones is not read.
_ENDINGS = ('.jpg', '.jpeg', '.png', '.tif', '.tiff', '.bmp', '.fits', '.fit', '.fts', '.heic')
_DIAGONAL_35_MM = 43.2666  # diagonal of a frame of 36 mm x 24 mm
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit, Exif 2.32
_EXIF, _GPS = 0x8769, 0x8825  # groups of tags, Exif 2.32
_BITS_OF_PNG = 24  # place in the file
_SAME_STAMP_NS = NANOSECONDS_PER_SECOND  # file times are often equal; stamps must differ
# Outside of it a clock was not set, or a file is damaged; stamps of ROS end in 2038.
_DATES = datetime(1990, 1, 1, tzinfo=timezone.utc), datetime(2037, 1, 1, tzinfo=timezone.utc)
_FIRST_NS, _LAST_NS = (round(date.timestamp()) * NANOSECONDS_PER_SECOND for date in _DATES)
_NAMES_SHOWN, _MOST_REASONS = 3, 8
_LONGEST_EXPOSURE_S = 86400.0
GIVEN = '--focal-length-mm and --pixel-size-um'
NOT_STATED = FileFacts()
# Focal length over the diagonal: fields of 160 degrees to 0.1 degrees.
_SHORTEST, _LONGEST = 0.08, 600.0
# Tags before the pixels: Pillow would look through all of a damaged file for them, byte by byte.
_JPEG_HEADER_BYTES = 2**22


@dataclass(frozen=True)
class Photograph:
    """
    Facts that a file states about its image.

    ``time_ns`` middle of the exposure; ``dated`` False where it is the time of the file, and
    ``utc`` False where its time zone is not known.  ``focal_lengths`` are those stated, the
    likeliest first.  ``site`` latitude, longitude (degrees) and height (m), or None;
    ``pointing`` right ascension and declination (degrees), or None.  ``camera`` names camera, lens
    and focal length, empty where the file does not; ``bits`` is the depth of a pixel.
    ``pixels_of`` and ``doubt`` say which pixels of the file are the image, and why a time is in
    doubt; ``is_upright`` is True if the file states the order of its rows, and ``flip`` is that of
    `FileFacts`.
    """

    path: Path
    time_ns: int
    dated: bool
    utc: bool
    width: int
    height: int
    focal_lengths: tuple[FocalLength, ...] = ()
    site: tuple[float, float, float] | None = None
    camera: str = ''
    file_bytes: int = 0
    bits: int = 8
    pointing: tuple[float, float] | None = None
    pixels_of: str = ''
    doubt: str = ''
    is_upright: bool = True
    flip: str = ''

    @property
    def focal_px(self) -> float:
        """Likeliest focal length; NaN where none is stated."""
        return self.focal_lengths[0].focal_px if self.focal_lengths else math.nan


def image_paths(paths: Iterable[Path]) -> list[Path]:
    """
    Files of paths, folders and patterns if an image is among them, else none: they are bags.

    Files that are no images are in the list too, so that each is read or refused with a reason.
    A folder with a bag in it is a bag.  Raises IngestError for a pattern that matches nothing, and
    for images beside a bag.
    """
    files: dict[Path, None] = {}  # each once
    bags: list[Path] = []
    expanded = {pattern: matching(pattern) for pattern in paths}
    if nothing := next((pattern for pattern, found in expanded.items() if not found), None):
        raise IngestError(f'{nothing}: no such files')
    for path in itertools.chain.from_iterable(expanded.values()):
        if not path.is_dir():
            files[path] = None
        elif not (any(path.glob('*.mcap*')) or (path / 'metadata.yaml').exists()):
            names = sorted(file for file in path.iterdir() if not file.name.startswith('.'))
            files |= dict.fromkeys(names)
        else:
            bags.append(path)
    if not any(map(_is_image, files)):
        return []
    if bags:
        raise IngestError(
            f'{bags[0]}: a bag, and the other paths hold images: give only one of the two'
        )
    return [*files]


def images_of(paths: Sequence[Path]) -> list[Path]:
    """`image_paths` of which one is an image; raises IngestError otherwise."""
    if files := image_paths(paths):
        return files
    raise IngestError(f'{paths[0]}: no images')


def _is_image(path: Path) -> bool:
    """True if a file is an image of any kind, or was to be one by its name."""
    with contextlib.suppress(OSError, ValueError, IngestError):
        kind = kind_of(path)
        if kind is not UNKNOWN:
            return kind.is_image
    return path.name.lower().endswith(_ENDINGS)


class Refusals:
    """Files that are left out, or cannot be used, counted by their reason."""

    def __init__(self, outcome: str = 'left out') -> None:
        self._outcome = outcome
        self._names: dict[str, list[str]] = {}

    @contextlib.contextmanager
    def of(self, path: Path) -> Iterator[None]:
        """Count a file whose reading in the block raises IngestError."""
        try:
            yield
        except IngestError as error:
            self.add(path, str(error).removeprefix(f'{path}: '))

    def add(self, path: Path, reason: str) -> None:
        """Count a file."""
        self._names.setdefault(reason, []).append(path.name)

    def lines(self) -> list[str]:
        """A line for each reason, with a few names."""
        by_count = sorted(self._names.items(), key=lambda item: -len(item[1]))
        lines = [self._line(names, reason) for reason, names in by_count[:_MOST_REASONS]]
        if others := [name for _, names in by_count[_MOST_REASONS:] for name in names]:
            lines.append(self._line(others, 'for other reasons'))
        return lines

    def _line(self, names: Sequence[str], reason: str) -> str:
        count = counted(len(names), 'file')
        more = ', ...' if len(names) > _NAMES_SHOWN else ''
        return f'{self._outcome}: {count} ({", ".join(names[:_NAMES_SHOWN])}{more}): {reason}'


def _readable(path: Path) -> FileKind:
    """Kind of an image that is read; raises IngestError for another file."""
    if path.is_dir():
        raise IngestError(f'{path}: a folder: give it too, or leave it out')
    with errors_as(IngestError, path):
        kind = kind_of(path)
    if kind is UNKNOWN:
        raise IngestError(f'{path}: no image that is read, by its content: {IMAGES_READ}')
    if not kind.is_image:
        raise IngestError(f'{path}: {kind.name}: calibrate it by itself')
    return kind


def look_at(
    path: Path,
    focal_length_mm: float = 0.0,
    pixel_um: float = 0.0,
    facts: FileFacts = NOT_STATED,
) -> Photograph:
    """Facts of a file; what the user states of it replaces its own.  Raises IngestError."""
    kind = _readable(path)
    if kind is FITS:
        stated, stated_mm, stated_um = _of_fits(path, read_fits(path))
    else:
        tags, gps, width, height = (
            _facts_of_raw(path) if kind is RAW else _facts_of_picture(path, kind)
        )
        stated = _of_tags(path, tags, gps, width, height)
        stated_mm, stated_um = _real(tags.get('FocalLength')), _pixel_um(tags, width)
    if (time_ns := facts.time_ns(path)) is not None:
        stated = replace(stated, time_ns=time_ns, dated=True, utc=True, doubt='')
    pixels_of = '; '.join(filter(None, [stated.pixels_of, facts.pixels_of]))
    stated = replace(stated, pixels_of=pixels_of, flip=facts.flip)
    diagonal_px = math.hypot(stated.width, stated.height)
    if focal_length_mm or pixel_um:
        focal_mm, size_um = focal_length_mm or stated_mm, pixel_um or stated_um
        for name, other, value in (
            ('--focal-length-mm', '--pixel-size-um', size_um),
            ('--pixel-size-um', '--focal-length-mm', focal_mm),
        ):
            if not value > 0:
                raise IngestError(f'{path}: {name} needs {other}: the file does not state it')
        given_px = _focal_px(focal_mm, size_um)
        if _SHORTEST < given_px / diagonal_px < _LONGEST:
            return replace(stated, focal_lengths=(FocalLength(given_px, GIVEN),))
        raise IngestError(
            f'{path}: {GIVEN} give a focal length of {given_px:.3g} px for'
            f' {stated.width} x {stated.height} pixels'
        )
    # No camera has others.
    return replace(
        stated,
        focal_lengths=tuple(
            one
            for one in stated.focal_lengths
            if _SHORTEST < one.focal_px / diagonal_px < _LONGEST
        ),
    )


def in_order(photographs: Sequence[Photograph]) -> list[Photograph]:
    """
    By time, the deepest, then the largest file first; equal stamps a second apart.

    The first of several files of one exposure is kept, by their pixels.
    """
    ordered = sorted(
        photographs, key=lambda one: (one.time_ns, -one.bits, -one.file_bytes, one.path.name)
    )
    distinct: list[Photograph] = []
    for one in ordered:
        if distinct and one.time_ns <= distinct[-1].time_ns:
            one = replace(one, time_ns=distinct[-1].time_ns + _SAME_STAMP_NS)
        distinct.append(one)
    return distinct


def by_camera(photographs: Sequence[Photograph], fewest: int = 3) -> dict[str, list[Photograph]]:
    """
    Photographs of each camera and image size.

    First are groups that suffice; of those the deepest, since previews of the same exposures may
    outnumber them, then dated ones, then the largest.
    """
    groups: dict[str, list[Photograph]] = {}
    for one in photographs:
        groups.setdefault(f'{one.camera} {one.width} x {one.height}'.strip(), []).append(one)

    def rank(item: tuple[str, list[Photograph]]) -> tuple[bool, int, int, int]:
        group = item[1]
        bits, dated = min(one.bits for one in group), sum(one.dated for one in group)
        return len(group) < fewest, -min(bits, 16), -dated // len(group), -len(group)

    return dict(sorted(groups.items(), key=rank))


def pixels_of_photograph(
    path: Path, channel: str = '', is_rendered: bool | None = None, flip: str = ''
) -> Pixels:
    """
    Light of each pixel (height, width), as the sensor has it: not turned by the EXIF orientation.

    ``flip`` is that of `FileFacts`.
    A channel of a colour image, by default green, interpolated in a mosaic.  Of 8-bit images that
    are rendered, the sRGB curve is undone into 16 bit; None: those in colour are.
    """
    kind, channel = _readable(path), channel or 'green'
    if kind is RAW:
        values = _linear(path)
    elif kind is FITS:
        image = read_fits(path)
        values = image.values
        if image.mosaic:
            values = _interpolated(values, image.mosaic, channel)
    else:
        content = content_of(path)
        with _quiet():
            if kind is JPEG:
                _check_whole(path, content)
            values = in_rgb(decoded(path, content))  # the EXIF orientation is not applied
    values = mirrored(values, flip)
    if values.ndim == 3:
        values = np.ascontiguousarray(values[:, :, CHANNELS.index(channel)])
        is_rendered = True if is_rendered is None else is_rendered
    if values.dtype == np.uint8 and is_rendered:
        return np.asarray(_SRGB_TO_LIGHT[values])
    if values.dtype in (np.uint8, np.uint16):
        return np.ascontiguousarray(values)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    scale = scale_of([values.dtype], low, high)
    return scale.to_dn(values) if scale.step > 0 else np.zeros(values.shape, np.uint16)


def _interpolated(values: NDArray[Any], mosaic: str, channel: str) -> NDArray[Any]:
    """A colour of a mosaic at each pixel, linear as that of camera raw (`_linear`)."""
    has = np.array([letter == channel[0] for letter in mosaic]).reshape(2, 2)
    height, width = values.shape
    is_of = np.tile(has, (height // 2 + 1, width // 2 + 1))[:height, :width]
    kernel = np.array([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]])
    # A border mirrored about the last pixel has the colours of the mosaic.
    sums, weights = (
        cv2.filter2D(part, cv2.CV_64F, kernel, borderType=cv2.BORDER_REFLECT_101)
        for part in (np.where(is_of, values, 0).astype(np.float64), is_of.astype(np.float64))
    )
    everywhere = np.where(is_of, values, sums / weights)
    whole = values.dtype.kind in 'ui'
    return (np.rint(everywhere) if whole else everywhere).astype(values.dtype)


def _check_whole(path: Path, content: bytes) -> None:
    """Raise IngestError for a JPEG that ends early: OpenCV fills what is missing with grey."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content)) as image:
            image.draft('L', (image.width // 8, image.height // 8))  # not the pixels themselves
            image.load()
    except Exception as error:  # a damaged file makes Pillow raise anything
        raise IngestError(f'{path}: damaged') from error


def _srgb_to_light() -> NDArray[np.uint16]:
    """Light in 16 bit of the 8-bit values of sRGB, IEC 61966-2-1."""
    value = np.arange(256) / 255.0
    light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.rint(65535.0 * light).astype(np.uint16)


_SRGB_TO_LIGHT = _srgb_to_light()


_Tags = Mapping[str, Any]  # values by the names of the tags in Exif 2.32


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Drop the lines that libpng, libtiff and OpenCV print on a damaged file."""
    with open(os.devnull, 'wb') as nothing, contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # there is no stderr
            kept = os.dup(2)
            stack.callback(os.close, kept)
            os.dup2(nothing.fileno(), 2)
            stack.callback(os.dup2, kept, 2)
        yield


def _facts_of_picture(path: Path, kind: FileKind) -> tuple[_Tags, _Tags, int, int]:
    """Tags of EXIF and GPS, width and height."""
    with needing('', IngestError, path):
        from PIL import ExifTags, Image
    start = content_of(path, _JPEG_HEADER_BYTES) if kind is JPEG else content_of(path)
    try:
        # Opened, not decoded: size and tags only.
        with warnings.catch_warnings(), Image.open(io.BytesIO(start)) as image:
            warnings.simplefilter('ignore')
            width, height = image.size
            _check_size(path, width, height)
            exif = image.getexif()
            by_number = {**dict(exif), **dict(exif.get_ifd(_EXIF))}
            tags = {ExifTags.TAGS.get(tag, ''): value for tag, value in by_number.items()}
            by_number = dict(exif.get_ifd(_GPS))
            gps = {ExifTags.GPSTAGS.get(tag, ''): value for tag, value in by_number.items()}
            if kind is PNG:  # Pillow has no mode for colours of 16 bit
                tags['BitsPerSample'] = start[_BITS_OF_PNG]
    except IngestError:
        raise
    except Exception as error:  # a damaged file makes Pillow raise anything
        raise IngestError(f'{path}: {kind.name}, not readable: damaged') from error
    return tags, gps, width, height


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MOST_VALUES:
        raise IngestError(f'{path}: claims {width} x {height} pixels')


def _facts_of_raw(path: Path) -> tuple[_Tags, _Tags, int, int]:
    """Return the same of camera raw, as far as LibRaw reads them."""
    with _raw(path) as raw:
        sizes, stated, lens = raw.sizes, raw.other, raw.lens
    taken = stated.timestamp  # the digits of the camera's clock, whatever its time zone
    tags = {
        'ExposureTime': stated.shutter_speed,
        'FocalLength': stated.focal_length,
        'DateTimeOriginal': f'{taken:%Y:%m:%d %H:%M:%S}' if taken else '',
        'LensModel': f'{lens.make} {lens.model}'.strip(),
        'BitsPerSample': 16,
    }
    _check_size(path, sizes.width, sizes.height)
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
        raise IngestError(f'{path}: camera raw, not readable: {why}') from error


def _rawpy(path: Path) -> Any:
    with needing('raw', IngestError, path):
        return importlib.import_module('rawpy')


def _of_tags(path: Path, tags: _Tags, gps: _Tags, width: int, height: int) -> Photograph:
    """Facts of tags of EXIF."""
    time_ns, dated, utc = _exif_time(path, tags)
    names = (tags.get(tag) for tag in ('Make', 'Model', 'BodySerialNumber', 'LensModel'))
    words = [str(name).strip('\0 ') for name in names if name]
    focal_mm, pixel_um = _real(tags.get('FocalLength')), _pixel_um(tags, width)
    by_tags = 'focal length and pixel size of EXIF'
    if words and focal_mm > 0:
        words.append(f'{focal_mm:g} mm')
    focal_px = _focal_px(focal_mm, pixel_um)
    equivalent_mm = _real(tags.get('FocalLengthIn35mmFilm'))  # 0: unknown
    if math.isnan(focal_px) and equivalent_mm > 0:
        focal_px = math.hypot(width, height) * equivalent_mm / _DIAGONAL_35_MM
        by_tags = 'FocalLengthIn35mmFilm of EXIF'
    scales = () if math.isnan(focal_px) else (FocalLength(focal_px, by_tags),)
    site, camera = _exif_site(gps), ' '.join(words)
    size, bits = path.stat().st_size, int(np.max(tags.get('BitsPerSample', 8)))
    return Photograph(path, time_ns, dated, utc, width, height, scales, site, camera, size, bits)


def _real(value: object) -> float:
    """A number of EXIF, NaN for none: rationals may have a denominator of zero."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return math.nan


def _text(tags: _Tags, *names: str) -> str:
    """Text of the first of some tags that has one; empty for none."""
    return str(next(filter(None, map(tags.get, names)), '')).strip('\0 ')


def _pixel_um(tags: _Tags, width: int) -> float:
    """Size of a pixel by FocalPlaneXResolution, of the full image of ExifImageWidth."""
    per_unit = _real(tags.get('FocalPlaneXResolution'))
    unit_mm = _UNIT_MM.get(tags.get('FocalPlaneResolutionUnit', 2), math.nan)
    full = _real(tags.get('ExifImageWidth', width))
    if not (per_unit > 0 and full > 0):
        return math.nan
    return 1000.0 * unit_mm / per_unit * full / width


def _focal_px(focal_mm: float, pixel_um: float) -> float:
    """Focal length in pixels; NaN where it or the size of a pixel is not known."""
    return 1000.0 * focal_mm / pixel_um if focal_mm > 0 and pixel_um > 0 else math.nan


def _exif_time(path: Path, tags: _Tags) -> tuple[int, bool, bool]:
    """Stamp of the middle of the exposure, and whether it has a date and a time zone."""
    exposure_s = _real(tags.get('ExposureTime'))
    half_s = 0.5 * exposure_s if 0 < exposure_s < _LONGEST_EXPOSURE_S else 0.0
    zone = _text(tags, 'OffsetTimeOriginal', 'OffsetTime')
    text = _text(tags, 'DateTimeOriginal', 'DateTime')
    with contextlib.suppress(ValueError, OverflowError):
        aware = datetime.strptime(f'{text} {zone or "+0000"}', '%Y:%m:%d %H:%M:%S %z')
        if _DATES[0] <= aware < _DATES[1]:
            digits = _text(tags, 'SubsecTimeOriginal')
            part_s = float(f'0.{digits}') if digits.isdecimal() and len(digits) < 10 else 0.0
            middle_s = aware.timestamp() + part_s + half_s
            return round(middle_s * NANOSECONDS_PER_SECOND), True, bool(zone)
    return _time_of_file(path), False, False


def _time_of_file(path: Path) -> int:
    """Stamp of the last change of a file."""
    with errors_as(IngestError, path):
        return min(max(path.stat().st_mtime_ns, _FIRST_NS), _LAST_NS)


def _exif_site(gps: _Tags) -> tuple[float, float, float] | None:
    try:
        degrees = [
            # Degrees, minutes and seconds, or fewer of them.
            sum(float(part) / 60.0**k for part, k in zip(gps[tag], range(3), strict=False))
            * (-1.0 if str(gps[f'{tag}Ref']).upper()[:1] in 'SW' else 1.0)
            for tag in ('GPSLatitude', 'GPSLongitude')
        ]
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    height_m = _real(gps.get('GPSAltitude'))
    if not (abs(degrees[0]) <= 90 and abs(degrees[1]) <= 180):
        return None
    return degrees[0], degrees[1], height_m if -500 < height_m < 1e5 else 0.0


def _of_fits(path: Path, image: FileImage) -> tuple[Photograph, float, float]:
    """Facts of a FITS file, its focal length (mm) and the size of its pixels (um)."""
    header = image.header
    for key in FACTS['kind of the frame'].keywords:
        kind = str(header[key].value).strip().lower() if key in header else ''
        if re.search('dark|flat|bias', kind):
            raise IngestError(f'{path}: no image of the sky: {key} is {kind[:40]!r}')
    moment, dated, doubt = Moment(_time_of_file(path), is_utc=False), False, ''
    try:
        found = fits_facts.moment_of(header)
        if _FIRST_NS <= found.time_ns < _LAST_NS:
            moment, dated = found, True
            doubt = '' if found.is_utc else found.doubt
    except (ValueError, OverflowError) as error:
        doubt = str(error).partition(': give --')[0]
    names = (str(header[key].value) for key in FACTS['camera'].keywords if key in header)
    height, width = image.values.shape[:2]
    stated = Photograph(
        path,
        moment.time_ns,
        dated,
        dated and moment.is_utc,
        width,
        height,
        tuple(fits_facts.focal_lengths_of(header)),
        fits_facts.site_of(header),
        ' '.join(names),
        path.stat().st_size,
        8 * image.values.dtype.itemsize,
        fits_facts.pointing_of(header),
        image.pixels_of,
        doubt,
        'ROWORDER' in header,
    )
    return stated, number_of(header, 'focal length'), number_of(header, 'pixel size')
