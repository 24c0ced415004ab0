# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The prior camera in the pixels of images of another size: binned ones, or a region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from starcal_ros.camera import CameraModel
from starcal_ros.records import Image

OF_FILE = '# in the file of camera_info_url: '


def camera_of_size(images: Sequence[Image], prior: CameraModel) -> CameraModel:
    """The prior camera, or one for images of which none has its size, binned where they can be."""
    sizes = {image.pixels.shape for image in images}
    own = {(prior.height, prior.width), (prior.width, prior.height)}
    if not sizes or sizes & own:
        return prior
    height, width = max(sizes)
    bins = max(prior.width // width, 1)
    if (prior.width // bins, prior.height // bins) == (width, height):
        return binned(prior, bins)
    middle = (width - 1) / 2, (height - 1) / 2
    return replace(prior, width=width, height=height).replace(cx=middle[0], cy=middle[1])


def binned(camera: CameraModel, bins: int) -> CameraModel:
    """The camera of bins of pixels; (0, 0) is the centre of the first pixel, and of a bin."""
    fx, skew, fy, cx, cy = (float(value) for value in camera.intrinsics)
    size = replace(camera, width=camera.width // bins, height=camera.height // bins)
    return size.replace(
        fx=fx / bins,
        skew=skew / bins,
        fy=fy / bins,
        cx=(cx + 0.5) / bins - 0.5,
        cy=(cy + 0.5) / bins - 0.5,
    )


def stated_camera(prior: CameraModel, shown: CameraModel, bins: int) -> CameraModel:
    """
    The prior camera in the pixels of images that show a camera, as far as it states them.

    Its matrix may be of the pixels of the images, or of unbinned ones: that with the nearer
    principal point is taken, and the camera shown where neither has the size of the images.
    """
    size = shown.width, shown.height
    matrices = [prior] if size == (prior.width, prior.height) else []
    whole = binned(prior, max(bins, 1))
    if bins > 1 or size == (whole.width, whole.height):
        matrices.append(replace(whole, width=shown.width, height=shown.height))
    return min(
        matrices or [shown],
        key=lambda one: float(np.hypot(*(one.parameters[3:5] - shown.parameters[3:5]))),
    )


def sizes_in_words(images: CameraModel, prior: CameraModel) -> str:
    """Sizes of images and of the prior camera, as the start of a sentence."""
    return (
        f'The images are {images.width} x {images.height}, the prior camera is of'
        f' {prior.width} x {prior.height}'
    )


def size_of_file(camera: CameraModel) -> str:
    """The size of a camera as a line of a camera file, to which numbers are appended."""
    return f'{OF_FILE}image_width: {camera.width}, image_height: {camera.height}, '


def numbers_of_file(camera: CameraModel) -> str:
    """Focal lengths and principal point of a camera for a camera file."""
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics)
    return f'fx, fy, cx, cy = {fx:.2f}, {fy:.2f}, {cx:.2f}, {cy:.2f}'


def centre_of_region(prior: CameraModel) -> str:
    """Principal point of a region of the detector for a camera file."""
    cx, cy = (float(value) for value in prior.parameters[3:5])
    return f'cx = {cx:.2f} - x_offset, cy = {cy:.2f} - y_offset of the region'
