# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images without the distortion of their camera, by the maps of ``cv2.remap``.

The straight camera is a pinhole of the same size, focal length and principal point, with square
pixels and without skew: the scale in the middle of an image stays.  Light that such a camera has
beyond its borders is lost.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from starcal_ground.fits_images import read_fits
from starcal_ground.mirror import flips_in, mirrored
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Singles
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.errors import IngestError
from starcal_ros.formats.image_files import content_of, decoded, is_fits
from starcal_ros.records import Calibration, PIXELS_OF

_ROWS = 128  # rows of a map made at once: those of 5 megapixels together take a gigabyte
_OUTSIDE_PX = -1e4  # cv2.remap gives such a pixel no light; it does not define that of NaN
_ENDINGS = ('.png', '.tif', '.tiff', '.jpg', '.jpeg')  # kinds of files that keep their kind


def straight_camera(camera: CameraModel) -> CameraModel:
    """Pinhole camera of the same size and principal point, and of the mean focal length."""
    fx, _, fy, cx, cy = camera.parameters[:5].tolist()
    focal_px = math.sqrt(fx * fy)
    parameters = np.array([focal_px, 0.0, focal_px, cx, cy, 0.0, 0.0, 0.0, 0.0, 0.0])
    return CameraModel(camera.width, camera.height, parameters)


def undistort_maps(calibration: Calibration) -> tuple[Singles, Singles]:
    """
    Maps for ``cv2.remap`` from images of a calibrated camera to those of its straight camera.

    The straight camera has the size, the principal point and the mean focal length of the
    calibrated one, square pixels, no skew and no distortion.

    Returns
    -------
    map_u, map_v : (height, width) float32
        Pixel of the camera for each pixel of the straight one; -10000 where it sees nothing.

    Examples
    --------
    >>> import cv2, numpy as np, starcal_ground
    >>> map_u, map_v = starcal_ground.undistort_maps(starcal_ground.read_calibration('out'))
    >>> image = np.zeros(map_u.shape, np.uint16)
    >>> cv2.remap(image, map_u, map_v, cv2.INTER_LANCZOS4).shape == image.shape
    True
    """
    camera = calibration.geometry.camera
    straight = straight_camera(camera)
    maps = np.empty((2, camera.height, camera.width), np.float32)
    for first in range(0, camera.height, _ROWS):
        rows = slice(first, min(first + _ROWS, camera.height))
        v, u = np.mgrid[rows, : camera.width]
        pixels = project(camera, line_of_sight(straight, np.stack([u, v], axis=-1)))
        maps[:, rows] = np.moveaxis(pixels, -1, 0)
    maps[:, np.isnan(maps).any(axis=0)] = _OUTSIDE_PX
    return maps[0], maps[1]


def written_to(path: Path, folder: Path) -> Path:
    """File of an image without distortion: as it was if PNG, TIFF or JPEG, else a TIFF."""
    ending = path.suffix if path.suffix.lower() in _ENDINGS else '.tiff'
    return folder / f'{path.name.partition(".")[0]}{ending}'


def flips_of(calibration: Calibration) -> list[str]:
    """Flips of `MIRRORED` of the image files that a calibration was made from."""
    return flips_in(calibration.provenance.get(PIXELS_OF, ''))


def undistort_file(
    path: Path, calibration: Calibration, maps: tuple[Singles, Singles], output: Path
) -> None:
    """
    Write an image without distortion; colours and bits per value stay, wide types become float32.

    ``maps`` are those of `undistort_maps`.  Files that the calibration took for mirrored images
    are mirrored back.

    Raises IngestError for a file that is no image of the camera, and ProductError for one that
    cannot be written.
    """
    if is_fits(path):
        image = read_fits(path)
        if image.mosaic:
            raise IngestError(f'{path}: a colour mosaic ({image.mosaic}): separate its colours')
        values = image.values
    else:
        values = decoded(path, content_of(path))
    for flip in flips_of(calibration):
        values = mirrored(values, flip)
    height, width = maps[0].shape
    if values.shape[:2] != (height, width):
        size = f'{values.shape[1]} x {values.shape[0]}'
        raise IngestError(f'{path}: {size} pixels, not {width} x {height} as the camera')
    if values.dtype not in (np.uint8, np.uint16):
        values = values.astype(np.float32)  # cv2.remap takes no wider integers
    # Lanczos moves a star by 0.006 px rms, the cubic and the linear kernel by 0.015.
    straight = cv2.remap(np.ascontiguousarray(values), *maps, cv2.INTER_LANCZOS4)
    _, content = cv2.imencode(output.suffix, straight)
    write_marked(output, content.tobytes())
