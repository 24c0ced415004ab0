# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Annotated pictures of images with their predicted, measured and refused stars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import textwrap

import cv2
import numpy as np

from starcal_ros.arrays import Floats, Picture, Pixels, Singles
from starcal_ros.camera import project
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.text import counted

Color = tuple[int, int, int]  # blue, green, red

_PREDICTED = (255, 160, 0)  # blue
_MEASURED = (80, 220, 80)  # green
_TEXT = (255, 255, 255)
_BANNER = (40, 40, 200)  # red
_PANEL = (30, 30, 30)
_SHIFT = 4  # OpenCV draws in sixteenths of a pixel


@dataclass(frozen=True)
class Mark:
    """Marker of the stars refused for one reason: OpenCV marker type, colour and size."""

    shape: int
    color: Color
    size: float = 12.0  # per mille of the longer side of the picture


# Shape and colour both differ, for colour-blind readers.  Reasons explained by the sky or by
# limits are pale; reasons that indicate a problem of camera or catalog stand out.
STAR_MARKS: Mapping[str, Mark] = {
    'not_detected': Mark(cv2.MARKER_TRIANGLE_DOWN, (190, 190, 190)),
    'border': Mark(cv2.MARKER_SQUARE, (190, 190, 190)),
    'blend': Mark(cv2.MARKER_SQUARE, (255, 80, 220)),
    'saturated': Mark(cv2.MARKER_TRIANGLE_UP, (0, 230, 255)),
    'too_few_pixels': Mark(cv2.MARKER_TRIANGLE_UP, (190, 190, 190)),
    'elongated': Mark(cv2.MARKER_TILTED_CROSS, (0, 150, 255)),
    'hot_pixel': Mark(cv2.MARKER_CROSS, (80, 80, 255)),
    'faint': Mark(cv2.MARKER_DIAMOND, (150, 150, 150), 6.0),  # by far the most frequent
    'ambiguous': Mark(cv2.MARKER_STAR, (80, 80, 255)),
}
"""Name of `STAR_REFUSALS` -> its mark."""

_UNKNOWN = Mark(cv2.MARKER_STAR, _TEXT)  # a reason from another version


def annotate(image: Image, observations: StarObservations, geometry: CameraGeometry) -> Picture:
    """
    Picture (height, width, 3) BGR of an image, which may be reduced, with its stars marked.

    Crosses mark the predicted and circles the measured positions of the used stars; refused stars
    carry the mark of their reason, which the legend lists with its count.  A banner names the
    reason of a refused image.  ``geometry`` predicts the stars.
    """
    picture = annotate_reduced(image.pixels, observations, geometry)
    size = _mark_size(picture)
    top = _draw_banner(picture, observations, size)
    _draw_legend(picture, observations, size, top)
    return picture


def annotate_reduced(
    pixels: Pixels, observations: StarObservations, geometry: CameraGeometry
) -> Picture:
    """Picture of an image that was reduced to ``pixels``, with its stars marked, no legend."""
    picture = np.asarray(cv2.cvtColor(stretch(pixels), cv2.COLOR_GRAY2BGR), np.uint8)
    scale = pixels.shape[1] / max(observations.width, 1)
    size = _mark_size(picture)
    width = max(1, round(size))

    def reduced(places_px: Floats | Singles) -> Floats:
        return np.asarray((places_px + 0.5) * scale - 0.5, np.float64)

    for reason, places in observations.refused_places().items():
        for pixel in _pixels(reduced(places)):
            _draw_mark(picture, STAR_MARKS.get(reason, _UNKNOWN), pixel, size)
    for pixel in _pixels(reduced(predicted_px(observations, geometry))):
        _draw_mark(picture, Mark(cv2.MARKER_CROSS, _PREDICTED), pixel, size)
    for uv, snr in zip(reduced(observations.measured_px), observations.snr, strict=True):
        radius = (5 + 2 * np.log10(max(float(snr), 1.0))) * size
        (center,), radius = _pixels(uv[None], 1 << _SHIFT), int(radius * (1 << _SHIFT))
        cv2.circle(picture, center, radius, _MEASURED, width, cv2.LINE_AA, _SHIFT)
    return picture


def _mark_size(picture: Picture) -> float:
    return max(max(picture.shape) / 1000.0, 0.6)  # smaller text is illegible


def predicted_px(observations: StarObservations, geometry: CameraGeometry) -> Floats:
    """Pixels (n, 2) of the stars predicted by the geometry and the star tracker attitude."""
    icrf_from_camera = geometry.icrf_from_camera(observations.icrf_from_star_tracker_xyzw)
    directions = icrf_from_camera.inv().as_matrix() @ observations.direction_icrf.T
    return project(geometry.camera, directions.T)


def stretch(pixels: Pixels) -> Picture:
    """8-bit picture of an image: sky dark, faint stars visible, bright ones white."""
    # Quantiles of a sample of the pixels suffice for a picture.
    sample = pixels[:: max(1, pixels.shape[0] // 256), :: max(1, pixels.shape[1] // 256)]
    dark, sky, bright = np.percentile(sample, [1.0, 50.0, 99.9])
    noise = max(float(sky - dark) / 2.3, 0.5)
    top = max(float(bright - sky), 30.0 * noise)
    by_table = pixels.size > np.iinfo(pixels.dtype).max
    levels = np.arange(int(np.iinfo(pixels.dtype).max) + 1) if by_table else pixels
    signal = (levels.astype(np.float32) - (sky - noise)) / (2.0 * noise)
    curve = np.arcsinh(signal) / np.arcsinh(top / (2.0 * noise))
    shown = np.asarray(np.clip(20.0 + 220.0 * curve, 0.0, 255.0), np.uint8)
    return np.asarray(shown[pixels]) if by_table else shown


def _draw_mark(picture: Picture, mark: Mark, place: Sequence[int], size: float) -> None:
    width, length = max(1, round(size)), max(3, round(mark.size * size))
    cv2.drawMarker(picture, place, mark.color, mark.shape, length, width)


def _draw_banner(picture: Picture, observations: StarObservations, size: float) -> int:
    """Draw the refusal across the top of the picture and return the first row below it."""
    if not observations.refusal:
        return 0
    scale, line = 0.8 * size, round(32 * size)
    words = f'REFUSED {observations.refusal}: {observations.detail}'
    room_px = 0.9 * (picture.shape[1] - 20 * size)  # letters differ in width
    rows = textwrap.wrap(words, max(1, int(len(words) * room_px / _width_px(words, scale))))
    bottom = line * len(rows) + round(10 * size)
    cv2.rectangle(picture, (0, 0), (picture.shape[1], bottom), _BANNER, cv2.FILLED)
    for k, row in enumerate(rows):
        _write(picture, row, (round(10 * size), line * (k + 1)), scale, _TEXT)
    return bottom


def _draw_legend(
    picture: Picture, observations: StarObservations, size: float, top_px: int
) -> None:
    """Draw the marks with their meaning and count on a dark panel."""
    lines = [
        (STAR_MARKS.get(reason, _UNKNOWN), f'{count} {reason.replace("_", " ")}')
        for reason, count in sorted(observations.refused_stars.items())
        if count
    ]
    if not observations.refusal:
        used = f'{counted(len(observations), "star")}: predicted, measured'
        lines.insert(0, (Mark(cv2.MARKER_CROSS, _PREDICTED), used))
    if not lines:
        return
    scale, line = 0.6 * size, round(24 * size)
    widest = max(_width_px(text, scale) for _, text in lines)
    corner = (round(40 * size) + widest, top_px + line * len(lines) + round(10 * size))
    panel = picture[top_px : corner[1], : corner[0]]
    panel[:] = (0.35 * panel + 0.65 * np.array(_PANEL)).astype(np.uint8)
    for k, (mark, text) in enumerate(lines):
        base = top_px + line * (k + 1)
        place = (round(16 * size), base - round(6 * size))
        _draw_mark(picture, mark, place, size)
        if mark.color == _PREDICTED:
            width = max(1, round(size))
            cv2.circle(picture, place, round(8 * size), _MEASURED, width, cv2.LINE_AA)
        _write(picture, text, (round(32 * size), base), scale, _TEXT)


def _width_px(text: str, scale: float) -> int:
    thickness = max(1, round(2 * scale))
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    return width


def _write(
    picture: Picture, text: str, place: tuple[int, int], scale: float, color: Color
) -> None:
    thickness = max(1, round(2 * scale))
    cv2.putText(
        picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, thickness, cv2.LINE_AA
    )  # fmt: skip


def _pixels(places: Floats, per_pixel: int = 1) -> list[list[int]]:
    """Places (n, 2) in whole units, of which a pixel has some."""
    # Predictions far outside the image would overflow OpenCV's integers.
    inside = np.clip(np.nan_to_num(places, nan=-1e4), -1e4, 1e5) * per_pixel
    pixels: list[list[int]] = np.rint(inside).astype(int).tolist()
    return pixels
