# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Thumbnails of a few images and refused stars, stored beside the products for the report."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
import itertools
from pathlib import Path
import re

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ground.outputs import make_folder
from starcal_ros.arrays import Pixels
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.identification.blind.bright_sources import bright_sources
from starcal_ros.identification.prediction import predict, within_image
from starcal_ros.pipeline.annotation import annotate_reduced, stretch
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.untrusted import read_bytes

THUMBNAILS_FOLDER = 'thumbnails'
_USED = 6  # used images, evenly spread; between this and twice as many are kept
_REFUSED_OF_A_REASON = 2
_STARS_OF_A_REASON = 6
_WIDTH_PX = 480
_STAR_HALF_PX = 12
_NAME = re.compile(
    r'image_(?P<image_ns>-?\d{1,20})\.jpg'
    r'|star_(?P<star_ns>-?\d{1,20})_(?P<reason>[a-z_]{1,40})_(?P<n>\d{1,9})\.png'
)
_MAGIC = {'.jpg': b'\xff\xd8\xff', '.png': b'\x89PNG\r\n\x1a\n'}
_MOST_BYTES = 1 << 20  # of a picture: one of 480 x 480 pixels has a quarter
_MOST_FILES = 1000  # in a folder: a calibration writes under 200
EXPECTED = 'no_match_expected'  # in the names of these pictures
_EXPECTED_PICTURES = 3
_EXPECTED_STARS = 40  # brightest stars and sources
_EXPECTED_WIDTH_PX = 900
_EXPECTED_BGR, _SEEN_BGR = (80, 200, 255), (120, 255, 120)


@dataclass(frozen=True)
class Thumbnail:
    """A small picture; ``reason`` is empty for a whole image."""

    time_ns: int
    reason: str
    number: int
    encoded: bytes

    @property
    def name(self) -> str:
        """File name, which `read_thumbnails` parses."""
        if self.reason:
            return f'star_{self.time_ns}_{self.reason}_{self.number}.png'
        return f'image_{self.time_ns}.jpg'


@dataclass(frozen=True)
class _Reduced:
    """An image reduced to the width of a thumbnail, to be drawn if it is shown in the end."""

    pixels: Pixels
    observations: StarObservations
    geometry: CameraGeometry

    def drawn(self) -> Thumbnail:
        """Thumbnail with the stars marked."""
        picture = annotate_reduced(self.pixels, self.observations, self.geometry)
        _, encoded = cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, 80])
        return Thumbnail(self.observations.time_ns, '', 0, encoded.tobytes())


@dataclass
class Album:
    """
    Selects thumbnails from a stream of images.

    Keeps some used images, evenly spread, and the first images and stars of each refusal reason.
    ``expected`` images, if known, are spread from the start; more or fewer may come.  With a
    setup, ``unmatched`` are the first images that match no star, with the stars expected there.
    """

    expected: int = 0
    setup: Setup | None = None
    unmatched: list[Thumbnail] = field(default_factory=list)
    used: list[_Reduced] = field(default_factory=list)
    refused: dict[str, list[_Reduced]] = field(default_factory=dict)
    stars: dict[str, list[Thumbnail]] = field(default_factory=dict)
    _stride: int = 1
    _seen: int = 0

    def __post_init__(self) -> None:
        """Reduce no image that is not likely to be kept."""
        self._stride = max(1, -(-self.expected // (2 * _USED - 1)))

    def show(self, image: Image, observations: StarObservations, geometry: CameraGeometry) -> None:
        """Add an image, its observations and the geometry that predicted its stars."""
        if observations.refusal:
            of_refusal = self.refused.setdefault(observations.refusal, [])
            if len(of_refusal) < _REFUSED_OF_A_REASON:
                of_refusal.append(_Reduced(_reduced(image.pixels), observations, geometry))
        else:
            if self._seen % self._stride == 0:
                self.used.append(_Reduced(_reduced(image.pixels), observations, geometry))
                if len(self.used) == 2 * _USED:
                    self.used, self._stride = self.used[::2], 2 * self._stride
            self._seen += 1
        for reason, places in observations.refused_places().items():
            of_reason = self.stars.setdefault(reason, [])
            # At most one star per image, for variety.
            if len(of_reason) < _STARS_OF_A_REASON and len(places):
                number = len(of_reason)
                encoded = _cut_out(image.pixels, places[number % len(places)])
                of_reason.append(Thumbnail(image.time_ns, reason, number, encoded))
        number = len(self.unmatched)
        if self.setup and observations.refusal == 'no_match' and number < _EXPECTED_PICTURES:
            encoded = _expected_picture(image, observations, geometry, self.setup)
            self.unmatched.append(Thumbnail(image.time_ns, EXPECTED, number, encoded))

    def thumbnails(self) -> tuple[Thumbnail, ...]:
        """All selected thumbnails."""
        whole = [*self.used, *(one for group in self.refused.values() for one in group)]
        stars = [one for group in self.stars.values() for one in group]
        return (*(one.drawn() for one in whole), *stars)


def star_of(thumbnail: Thumbnail, observations: StarObservations) -> int | None:
    """Catalog number of the refused star of a thumbnail; None if the image has none such."""
    codes = {name: code for code, name in enumerate(observations.refused_stars)}
    of_reason = observations.refused_reason == codes.get(thumbnail.reason, -1)
    numbers = observations.refused_catalog_id[of_reason]
    return int(numbers[thumbnail.number % len(numbers)]) if len(numbers) else None


def write_thumbnails(thumbnails: Iterable[Thumbnail], folder: Path) -> None:
    """
    Write thumbnails to a folder and delete those of an earlier calibration.

    Raises ProductError when a file cannot be written, or the folder is a link.
    """
    make_folder(folder)
    for path in thumbnails_in(folder):
        with errors_as(ProductError, path, 'removed'):
            path.unlink()
    for thumbnail in thumbnails:
        write_atomically(folder / thumbnail.name, thumbnail.encoded)


def thumbnails_in(folder: Path) -> list[Path]:
    """Files with names of thumbnails in a folder; raises ProductError where it is a link."""
    if folder.is_symlink():
        raise ProductError(f'{folder}: is a link; remove it or choose another folder')
    with errors_as(ProductError, folder):
        there = folder.iterdir() if folder.exists() else ()
        return [path for path in there if _NAME.fullmatch(path.name)]


def read_thumbnails(folder: Path) -> tuple[Thumbnail, ...]:
    """
    Thumbnails of a folder in time order; none if there is no such folder.

    Only regular files that begin as a picture does are read: the folder may come from another
    user, and its content becomes part of the report.
    """
    if folder.is_symlink() or not folder.is_dir():
        return ()
    pictures = []
    for path in itertools.islice(sorted(folder.iterdir()), _MOST_FILES):
        name = _NAME.fullmatch(path.name)
        if name is None:
            continue
        try:
            encoded = read_bytes(path, _MOST_BYTES, follow_links=False)
        except (OSError, ValueError):
            continue
        if encoded.startswith(_MAGIC[path.suffix]):
            time_ns = int(name['image_ns'] or name['star_ns'])
            pictures.append(Thumbnail(time_ns, name['reason'] or '', int(name['n'] or 0), encoded))
    return ordered(pictures)


def ordered(thumbnails: Iterable[Thumbnail]) -> tuple[Thumbnail, ...]:
    """Thumbnails by time, reason and number; of those with one file name the last."""
    named = {thumbnail.name: thumbnail for thumbnail in thumbnails}
    return tuple(sorted(named.values(), key=lambda t: (t.time_ns, t.reason, t.number)))


def _reduced(pixels: Pixels) -> Pixels:
    """Pixels at the width of a thumbnail, or all of a smaller image."""
    height, width = pixels.shape
    if width <= _WIDTH_PX:
        return pixels.copy()
    # By a whole number first, in a third of the time.
    k = max(1, min(width // _WIDTH_PX, height))
    part = pixels[: height // k * k, : width // k * k]
    part = _resized(part, width // k, height // k)
    return _resized(part, _WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))


def _resized(pixels: Pixels, width: int, height: int) -> Pixels:
    # OpenCV's type stubs lack integer images.
    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]


def _cut_out(pixels: Pixels, place_px: NDArray[np.float32]) -> bytes:
    """PNG of the pixels about a place; black where that leaves the image."""
    u, v = np.rint(np.nan_to_num(np.clip(place_px, -1e4, 1e5), nan=-1e4)).astype(int)
    size = 2 * _STAR_HALF_PX + 1
    picture = np.zeros((size, size), np.uint8)
    first = np.array([v - _STAR_HALF_PX, u - _STAR_HALF_PX])
    low, high = np.maximum(first, 0), np.minimum(first + size, pixels.shape)
    if (low < high).all():
        part = pixels[low[0] : high[0], low[1] : high[1]]
        inside = tuple(slice(a, b) for a, b in zip(low - first, high - first, strict=True))
        picture[inside] = stretch(part)
    _, encoded = cv2.imencode('.png', picture)
    return encoded.tobytes()


def _expected_picture(
    image: Image, observations: StarObservations, geometry: CameraGeometry, setup: Setup
) -> bytes:
    """PNG with crosses where the brightest stars are expected and circles about the sources."""
    attitude, limit = (
        observations.icrf_from_star_tracker_xyzw,
        setup.identification.magnitude_limit,
    )
    stars = predict(geometry, attitude, image.time_ns, setup.catalog, limit, 0.0)
    stars = within_image(stars, geometry.camera.width, geometry.camera.height)
    scale = min(1.0, _EXPECTED_WIDTH_PX / image.pixels.shape[1])
    grey = cv2.resize(
        stretch(image.pixels), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
    )
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    for place in np.rint(stars.xy_px[:_EXPECTED_STARS] * scale).astype(int).tolist():
        cv2.drawMarker(picture, place, _EXPECTED_BGR, cv2.MARKER_CROSS, 13, 1, cv2.LINE_AA)
    seen_px = bright_sources(image.pixels).xy_px[:_EXPECTED_STARS]
    for place in np.rint(seen_px * scale).astype(int).tolist():
        cv2.circle(picture, place, 8, _SEEN_BGR, 1, cv2.LINE_AA)
    _, encoded = cv2.imencode('.png', picture)
    return encoded.tobytes()
