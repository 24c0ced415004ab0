# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Thumbnails of a few images, stored beside the products for the report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
import itertools
from pathlib import Path
import re

import cv2
import numpy as np

from starcal_ground.blind.bright_sources import bright_sources
from starcal_ground.products import make_folder
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Pixels
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.identification.prediction import predict
from starcal_ros.pipeline.annotation import annotate_reduced, stretch
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.untrusted import read_bytes

THUMBNAILS_FOLDER = 'thumbnails'
_USED = 6  # used images, evenly spread; between this and twice as many are kept
_REFUSED_OF_A_REASON = 2
_WIDTH_PX = 480
_NAME = re.compile(r'image_(?P<image_ns>-?\d{1,20})\.jpg|expected_(?P<ns>-?\d{1,20})\.png')
_MAGIC = {'.jpg': b'\xff\xd8\xff', '.png': b'\x89PNG\r\n\x1a\n'}
_MOST_BYTES = 1 << 20  # largest picture: one of 480 x 480 pixels has a quarter of it
_MOST_FILES = 1000  # in a folder: a calibration writes under 200
_EXPECTED_PICTURES = 3
_EXPECTED_STARS = 40  # brightest stars and sources
_EXPECTED_WIDTH_PX = 900
_EXPECTED_BGR, _SEEN_BGR = (80, 200, 255), (120, 255, 120)


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of an image, or a larger one with the stars expected in it."""

    time_ns: int
    encoded: bytes
    is_expected: bool = False

    @property
    def name(self) -> str:
        """File name, which `read_thumbnails` parses."""
        return f'expected_{self.time_ns}.png' if self.is_expected else f'image_{self.time_ns}.jpg'


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
        return Thumbnail(self.observations.time_ns, encoded.tobytes())


@dataclass
class Album:
    """
    Selects thumbnails from a stream of images.

    Keeps some used images, evenly spread, and the first images of each refusal reason.  With a
    setup, ``unmatched`` are the first images that match no star, with the stars expected there.
    """

    setup: Setup | None = None
    unmatched: list[Thumbnail] = field(default_factory=list)
    used: list[_Reduced] = field(default_factory=list)
    refused: dict[str, list[_Reduced]] = field(default_factory=dict)
    _stride: int = 1
    _seen: int = 0

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
        is_unmatched = observations.refusal == 'no_match'
        if self.setup and is_unmatched and len(self.unmatched) < _EXPECTED_PICTURES:
            encoded = _expected_picture(image, observations, geometry, self.setup)
            self.unmatched.append(Thumbnail(image.time_ns, encoded, is_expected=True))

    def thumbnails(self) -> tuple[Thumbnail, ...]:
        """All selected thumbnails."""
        return tuple(one.drawn() for one in self._selected())

    def thumbnails_again(
        self, again: Mapping[int, StarObservations], geometry: CameraGeometry
    ) -> tuple[Thumbnail, ...]:
        """Those of images measured again; ``again`` has what `show` was given by its `id`."""
        return tuple(
            replace(one, observations=again[id(one.observations)], geometry=geometry).drawn()
            for one in self._selected()
            if id(one.observations) in again
        )

    def _selected(self) -> list[_Reduced]:
        return [*self.used, *(one for group in self.refused.values() for one in group)]


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
        write_marked(folder / thumbnail.name, thumbnail.encoded)


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
            time_ns = int(name['image_ns'] or name['ns'])
            pictures.append(Thumbnail(time_ns, encoded, name['image_ns'] is None))
    return ordered(pictures)


def ordered(thumbnails: Iterable[Thumbnail]) -> tuple[Thumbnail, ...]:
    """Thumbnails by time; of those with one file name the last."""
    named = {thumbnail.name: thumbnail for thumbnail in thumbnails}
    return tuple(sorted(named.values(), key=lambda t: (t.time_ns, t.is_expected)))


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


def _expected_picture(
    image: Image, observations: StarObservations, geometry: CameraGeometry, setup: Setup
) -> bytes:
    """PNG with crosses where the brightest stars are expected and circles about the sources."""
    attitude, limit = (
        observations.icrf_from_star_tracker_xyzw,
        setup.identification.magnitude_limit,
    )
    stars = predict(geometry, attitude, image.time_ns, setup.catalog, limit, 0.0)
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
