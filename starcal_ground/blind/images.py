# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images of one camera identified without attitude or alignment.

The first image that is found gives its camera and handedness to the others, which are then quick:
for a diagnosis, within a limited time, all images are searched with their brightest sources before
any is searched further.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import dataclasses
from dataclasses import dataclass
import itertools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind import search
from starcal_ground.blind.bright_sources import bright_sources, BrightSources, smear
from starcal_ground.blind.search import Effort, SkyMatch
from starcal_ground.blind.sky_fit import FOUND, Ranges, STATED
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog
from starcal_ros.stars.streak import LONGEST_PX

_IMAGES = 8  # identified: more would not change an answer
_SEARCHED = 12  # at most
LOOKED_AT = 40  # at most, those without sources included
# Focal lengths over that of the camera, each searched to 25 %: of other pixels or of binned ones.
_OTHER_SCALES = (0.55, 1.8, 0.3, 3.3)
_FEW = 3  # identified, with which no image is searched further
FEWEST_SOURCES = 6
_BLURRED_ENDS_PX = 1.0  # the blurred ends lengthen the sources of a streak by it
_MOST_EFFORT = 2_500  # 10 to 15 s, most of a diagnosis; a real region of a detector took 1,518


@dataclass
class ImageSearch:
    """
    Search for images of one camera; the first match gives its camera and handedness to the others.

    ``camera`` is the prior of the images as they are given, then that of the first match;
    ``mirrored`` the ways that they are tried; ``ranges`` those of the camera, searched in turn, so
    that an image of another focal length is found too.  Images are given by rankings of their
    sources, each (n, 2), brightest first; that of the last match is tried first.
    """

    camera: CameraModel
    catalog: StarCatalog
    effort: Effort = dataclasses.field(default_factory=lambda: Effort(math.inf))
    mirrored: tuple[bool, ...] = (False, True)
    ranking: int = 0
    ranges: tuple[Ranges, ...] = (STATED,)

    def guess(self, rankings: Sequence[Floats], rotations: Iterable[Rotation]) -> SkyMatch | None:
        """Match of an image with one of some rotations ``camera_from_icrf``."""
        rows = self._order(rankings)
        for mirrored, rotation, row in itertools.product(self.mirrored, rotations, rows):
            sky = search.confirm_sky(
                rankings[row], self.camera, self.catalog, rotation, mirrored, self.ranges[0]
            )
            if sky:
                return self.take(sky, row)
        return None

    def look_up(
        self,
        rankings: Sequence[Floats],
        rounds: Sequence[tuple[int, int]] = search.ROUNDS,
        scales: Sequence[float] = (1.0,),
    ) -> SkyMatch | None:
        """Match of an image anywhere; ``scales`` of the focal length until there is a match."""
        cameras, rows = [self.camera], self._order(rankings)
        if len(self.mirrored) > 1:
            fx, fy = self.camera.parameters[[0, 2]].tolist()
            cameras = [self.camera.replace(fx=scale * fx, fy=scale * fy) for scale in scales]
        for ranges in self.ranges:
            sky, row = search.find_in_any(
                [rankings[row] for row in rows],
                cameras,
                self.catalog,
                self.mirrored,
                rounds,
                self.effort,
                ranges,
            )
            if sky:
                return self.take(sky, rows[row])
        return None

    def take(self, sky: SkyMatch, ranking: int) -> SkyMatch:
        """The match, whose camera the others have if it is the first."""
        self.ranking = ranking
        if len(self.mirrored) > 1:
            self.mirrored, self.ranges = (sky.mirrored,), (FOUND, STATED)
            self.camera = search.mirrored_camera(sky.camera) if sky.mirrored else sky.camera
        return sky

    def _order(self, rankings: Sequence[Floats]) -> list[int]:
        return sorted(range(len(rankings)), key=lambda row: row != self.ranking)


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

    sky: SkyMatch


@dataclass(frozen=True)
class Identified:
    """Images identified; sources of all images looked at; sizes (width, height) that differ."""

    solved: tuple[Solved, ...]
    sources: tuple[BrightSources, ...]
    other_sizes: tuple[tuple[int, int], ...]


Guesses = Callable[[int], Sequence[Rotation]]
"""Rotations ``camera_from_icrf`` that an image of a stamp may have, always in the same order."""


def identify_images(
    images: Iterable[Image],
    camera: CameraModel,
    catalog: StarCatalog,
    guesses: Guesses,
    most: float = _MOST_EFFORT,
) -> Identified:
    """
    The first images that can be identified, in the order of their stamps.

    ``guesses`` are tried before the sky is searched.  The search ends when it has cost
    ``most`` (`Effort`).
    """
    finder = ImageSearch(camera, catalog, Effort(most))
    looked_at: list[BrightSources] = []
    other_sizes: list[tuple[int, int]] = []
    solved: list[Solved] = []
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
        streak = smear(bright.sources)
        is_measured = streak is None or streak[0] < LONGEST_PX + _BLURRED_ENDS_PX
        if len(bright.sources.xy_px) >= FEWEST_SOURCES and is_measured:
            searched += 1
            rankings = bright.sources.rankings
            sky = finder.guess(rankings, guesses(bright.time_ns))
            if sky := sky or finder.look_up(rankings, search.ROUNDS[:1]):
                solved.append(Solved(**vars(bright), sky=sky))
            else:
                pending.append(bright)
            if len(pending) == _FEW and not solved:
                pending = _look_up(finder, pending, solved, search.ROUNDS[0], _OTHER_SCALES)
        if len(solved) == _IMAGES or searched == _SEARCHED or finder.effort.is_spent:
            break
    for later in search.ROUNDS[1:]:
        pending = _look_up(finder, pending, solved, later)
    solved.sort(key=lambda image: image.time_ns)
    return Identified(tuple(solved), tuple(looked_at), tuple(other_sizes))


def _look_up(
    finder: ImageSearch,
    pending: Sequence[_Sources],
    solved: list[Solved],
    searched: tuple[int, int],
    scales: Sequence[float] = (1.0,),
) -> list[_Sources]:
    """The images that a round of the search does not identify; ``solved`` gets the others."""
    unsolved = []
    for bright in pending:
        sky = None
        if len(solved) < _FEW and not finder.effort.is_spent:
            sky = finder.look_up(bright.sources.rankings, [searched], scales)
        if sky:
            solved.append(Solved(**vars(bright), sky=sky))
        else:
            unsolved.append(bright)
    return unsolved


def _sources(image: Image, camera: CameraModel) -> _Sources | None:
    """Sources of an image, turned to the sides of the camera; None if it has another size."""
    sides = (camera.height, camera.width)
    is_turned = image.pixels.shape != sides and image.pixels.shape[::-1] == sides
    pixels = np.ascontiguousarray(np.rot90(image.pixels)) if is_turned else image.pixels
    if pixels.shape != sides:
        return None
    return _Sources(image.time_ns, bright_sources(pixels), is_turned)
