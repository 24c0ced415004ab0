"""A picture of an image with what was seen in it: for people, never for numbers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.camera import project
from starcal_ros.records import CameraGeometry, Image, StarObservations

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

_PREDICTED = (255, 160, 0)  # blue, BGR
_MEASURED = (80, 220, 80)  # green
_TEXT = (255, 255, 255)
_REFUSED = (60, 60, 255)  # red
_SHIFT = 4  # OpenCV draws in sixteenths of a pixel


def annotate(image: Image, observations: StarObservations, geometry: CameraGeometry) -> Picture:
    """
    Picture (height, width, 3) BGR: predicted places as crosses, measured stars as circles.

    The counts of stars and of what was left out, by reason, or the refusal of the image, stand
    in the corner.  ``geometry`` is what the stars are predicted with.
    """
    picture = cv2.cvtColor(stretch(image.pixels), cv2.COLOR_GRAY2BGR)
    size = max(image.pixels.shape) / 1000.0
    width = max(1, round(size))
    for uv in predicted_px(observations, geometry):
        cv2.drawMarker(picture, _pixel(uv), _PREDICTED, cv2.MARKER_CROSS, round(12 * size), width)
    for uv, snr in zip(observations.measured_px, observations.snr, strict=True):
        radius = (5 + 2 * np.log10(max(float(snr), 1.0))) * size
        center, radius = _fixed_point(uv), int(radius * (1 << _SHIFT))
        cv2.circle(picture, center, radius, _MEASURED, width, cv2.LINE_AA, _SHIFT)
    for k, (text, color) in enumerate(_legend(observations)):
        place = (round(10 * size), round((k + 1) * 24 * size))
        # Dark below light: readable over stars and sky alike.
        for shade, stroke in (((0, 0, 0), 3 * width), (color, width)):
            cv2.putText(
                picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7 * size, shade, stroke,
                cv2.LINE_AA,
            )  # fmt: skip
    return np.asarray(picture, np.uint8)


def predicted_px(observations: StarObservations, geometry: CameraGeometry) -> Floats:
    """Pixels (n, 2) where the geometry and the star tracker's attitude put the stars."""
    icrf_from_camera = Rotation.from_quat(
        observations.icrf_from_star_tracker_xyzw
    ) * Rotation.from_quat(geometry.star_tracker_from_camera_xyzw)
    directions = icrf_from_camera.inv().as_matrix() @ observations.direction_icrf.T
    return project(geometry.camera, directions.T)


def stretch(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
    """8-bit picture of an image: sky dark, faint stars visible, bright ones white."""
    # A sample of the pixels: the picture needs no exact quantiles of thirteen million.
    sample = pixels[:: max(1, pixels.shape[0] // 256), :: max(1, pixels.shape[1] // 256)]
    dark, sky, bright = np.percentile(sample, [1.0, 50.0, 99.9])
    noise = max(float(sky - dark) / 2.3, 0.5)
    top = max(float(bright - sky), 30.0 * noise)
    levels = np.arange(int(np.iinfo(pixels.dtype).max) + 1, dtype=np.float32)
    curve = np.arcsinh((levels - (sky - noise)) / (2.0 * noise)) / np.arcsinh(top / (2.0 * noise))
    table = np.asarray(np.clip(20.0 + 220.0 * curve, 0.0, 255.0), np.uint8)
    return np.asarray(table[pixels])


def _legend(observations: StarObservations) -> list[tuple[str, tuple[int, int, int]]]:
    if observations.refusal:
        return [(f'{observations.refusal}: {observations.detail}', _REFUSED)]
    lines = [(f'{len(observations)} stars', _TEXT)]
    lines += [
        (f'{count} {reason.replace("_", " ")}', _REFUSED)
        for reason, count in sorted(observations.refused_stars.items())
        if count
    ]
    return lines


def _pixel(uv: Floats) -> tuple[int, int]:
    # Predictions far outside would overflow OpenCV's integers.
    u, v = np.clip(np.nan_to_num(uv, nan=-1e4), -1e4, 1e5)
    return round(float(u)), round(float(v))


def _fixed_point(uv: Floats) -> tuple[int, int]:
    u, v = np.clip(uv, -1e4, 1e5) * (1 << _SHIFT)
    return round(float(u)), round(float(v))
