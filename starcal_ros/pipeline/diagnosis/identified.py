# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images identified without attitude or alignment, within a limited time.

All images are searched with their brightest sources before any is searched further: one image
that is found gives the focal length and the handedness to the others, which are then quick.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import dataclasses
from dataclasses import dataclass
import itertools
import time

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.identification.blind import search
from starcal_ros.identification.blind.bright_sources import bright_sources, BrightSources, smear
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog

_IMAGES = 8  # identified: more would not change an answer
_SEARCHED = 12  # at most
LOOKED_AT = 40  # at most, those without sources included
# Focal lengths over that of the camera, each searched to 25 %: of other pixels or of binned ones.
_OTHER_SCALES = (0.55, 1.8, 0.3, 3.3)
_FEW = 3  # identified, with which no image is searched further
_FEWEST_SOURCES = 6
_SEARCH_S = 10.0  # of the 20 s that a diagnosis may take; reading and measuring are the rest
_MISFIT_PX = 3.0  # of a star whose identification is left out of a rotation


@dataclass(frozen=True)
class _Sources:
    """
    Sources of an image.

    ``quarter_turned``: the image has the sides of the prior camera exchanged, and was turned
    counterclockwise by 90 degrees.
    """

    time_ns: int
    sources: BrightSources
    quarter_turned: bool


@dataclass(frozen=True)
class Solved(_Sources):
    """
    An image that was identified.

    Rotation and camera of ``sky`` are of the image mirrored left to right where it is a mirror
    image.
    """

    sky: search.SkyMatch


@dataclass(frozen=True)
class Identified:
    """Images identified; sources of all images looked at; sizes (width, height) that differ."""

    solved: tuple[Solved, ...]
    sources: tuple[BrightSources, ...]
    other_sizes: tuple[tuple[int, int], ...]


Guesses = Callable[[int], Sequence[Rotation]]
"""Rotations ``camera_from_icrf`` that an image of a stamp may have, always in the same order."""


def identify_images(
    images: Iterable[Image], camera: CameraModel, catalog: StarCatalog, guesses: Guesses
) -> Identified:
    """
    The first images that can be identified, in the order of their stamps.

    ``guesses`` are tried before the sky is searched.  The search ends after 10 s of processor time
    of this thread.
    """
    finder = _Search(camera, catalog, guesses, time.thread_time() + _SEARCH_S)
    looked_at: list[BrightSources] = []
    other_sizes: list[tuple[int, int]] = []
    pending: list[_Sources] = []
    searched = 0
    for image in itertools.islice(images, LOOKED_AT):
        bright = _sources(image, camera)
        if bright is None:
            height, width = image.pixels.shape
            other_sizes.append((width, height))
            if len(other_sizes) == _SEARCHED:
                break
            continue
        looked_at.append(bright.sources)
        # The pattern of streaks is none of points.
        if len(bright.sources.xy_px) >= _FEWEST_SOURCES and smear(bright.sources) is None:
            searched += 1
            if not (finder.guess(bright) or finder.look_up(bright, search.ROUNDS[0])):
                pending.append(bright)
                if len(pending) == _FEW and not finder.solved:
                    pending = finder.look_up_rescaled(pending)
        if len(finder.solved) == _IMAGES or searched == _SEARCHED or finder.is_over():
            break
    for later in search.ROUNDS[1:]:
        last, pending = pending, []
        for bright in last:
            if len(finder.solved) >= _FEW or finder.is_over():
                break
            if not finder.look_up(bright, later):
                pending.append(bright)
    alike = sorted(_with_one_camera(finder.solved, catalog), key=lambda image: image.time_ns)
    return Identified(tuple(alike), tuple(looked_at), tuple(other_sizes))


def _sources(image: Image, camera: CameraModel) -> _Sources | None:
    """Sources of an image, turned to the sides of the camera; None if it has another size."""
    sides = (camera.height, camera.width)
    is_turned = image.pixels.shape != sides and image.pixels.shape[::-1] == sides
    pixels = np.ascontiguousarray(np.rot90(image.pixels)) if is_turned else image.pixels
    if pixels.shape != sides:
        return None
    return _Sources(image.time_ns, bright_sources(pixels), is_turned)


@dataclass
class _Search:
    """Identifies images one by one; the first one ``solved`` gives its camera to the others."""

    camera: CameraModel
    catalog: StarCatalog
    guesses: Guesses
    deadline_s: float
    solved: list[Solved] = dataclasses.field(default_factory=list)

    def is_over(self) -> bool:
        """True if the time given for the search has passed."""
        return time.thread_time() > self.deadline_s

    def guess(self, image: _Sources) -> bool:
        """True if one of its guessed rotations identifies an image."""
        rotations = self.guesses(image.time_ns)
        ways = [self.solved[0].sky.mirrored] if self.solved else [False, True]
        for mirrored, rotation in itertools.product(ways, rotations):
            sky = search.confirm_sky(
                image.sources.xy_px, self.camera, self.catalog, rotation, mirrored
            )
            if self._take(image, sky):
                return True
        return False

    def look_up(self, image: _Sources, searched: tuple[int, int], scale: float = 1.0) -> bool:
        """True if a round of the search identifies an image; ``scale`` of the focal length."""
        xy_px, width = image.sources.xy_px, self.camera.width
        fx, fy = (float(self.camera.parameters[k]) for k in (0, 2))
        camera, is_mirrored = self.camera.replace(fx=scale * fx, fy=scale * fy), False
        if self.solved:
            known = self.solved[0].sky
            focal_px, is_mirrored = float(known.camera.parameters[0]), known.mirrored
            prior = search.mirrored_camera(self.camera) if is_mirrored else self.camera
            camera = prior.replace(fx=focal_px, fy=focal_px * fy / fx)
        sky = search.find_sky(
            search.mirror(xy_px, width) if is_mirrored else xy_px,
            camera,
            self.catalog,
            try_mirrored=not self.solved,
            rounds=(searched,),
            deadline_s=self.deadline_s,
        )
        if isinstance(sky, search.SkyMatch) and is_mirrored:
            sky = dataclasses.replace(sky, mirrored=True, xy_px=search.mirror(sky.xy_px, width))
        return self._take(image, sky)

    def look_up_rescaled(self, pending: list[_Sources]) -> list[_Sources]:
        """The images that no focal length far from that of the camera identifies."""
        for scale in _OTHER_SCALES:
            unsolved = [
                image for image in pending if not self.look_up(image, search.ROUNDS[0], scale)
            ]
            if self.solved:
                return unsolved
        return pending

    def _take(self, image: _Sources, sky: search.SkyMatch | search.NotFound) -> bool:
        """Add an image to those solved if it was identified."""
        if isinstance(sky, search.NotFound):
            return False
        self.solved.append(Solved(**vars(image), sky=sky))
        return True


def _with_one_camera(solved: Sequence[Solved], catalog: StarCatalog) -> list[Solved]:
    """
    Images with the rotation that one camera for all gives.

    Each by itself cannot tell a rotation from a shift of the principal point.
    """
    if not solved:
        return []
    parameters = np.median([image.sky.camera.parameters for image in solved], axis=0)
    camera = dataclasses.replace(solved[0].sky.camera, parameters=parameters)
    return [
        dataclasses.replace(
            image,
            sky=dataclasses.replace(
                image.sky, camera_from_icrf=_rotation(image.sky, camera, catalog)
            ),
        )
        for image in solved
    ]


def _rotation(sky: search.SkyMatch, camera: CameraModel, catalog: StarCatalog) -> Rotation:
    """The rotation ``camera_from_icrf`` of an identified image with another camera."""
    xy_px = search.mirror(sky.xy_px, camera.width) if sky.mirrored else sky.xy_px
    lines = line_of_sight(camera, xy_px)
    stars = catalog.direction_icrs[sky.catalog_index]
    good = np.isfinite(lines[:, 0])
    limit_rad = _MISFIT_PX / float(camera.parameters[0])
    rotation = sky.camera_from_icrf
    for _ in range(2):
        if np.count_nonzero(good) < 3:
            return sky.camera_from_icrf
        rotation, _ = Rotation.align_vectors(lines[good], stars[good])
        apart = np.linalg.norm(rotation.apply(stars) - lines, axis=1)
        # A camera that fits all images on average may be some pixels off in one.
        good = apart < max(limit_rad, 2.0 * float(np.nanmedian(apart)))
    return rotation
