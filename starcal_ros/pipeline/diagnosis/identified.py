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
import time

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.identification.blind import search
from starcal_ros.identification.blind.bright_sources import bright_sources, BrightSources, smear
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog

IMAGES = 8  # identified: more would not change an answer
_SEARCHED = 12  # at most
LOOKED_AT = 40  # at most, those without sources included
# Focal lengths over that of the camera, each searched to 25 %: of other pixels or of binned ones.
_OTHER_SCALES = (0.55, 1.8, 0.3, 3.3)
_FEW = 3  # identified, with which no image is searched further
FEWEST_SOURCES = 6
SEARCH_S = 10.0  # of the 20 s that a diagnosis may take; reading and measuring are the rest
_MISFIT_PX = 3.0  # of a star whose identification is left out of a rotation


@dataclass(frozen=True)
class Solved:
    """
    An image that was identified, its sources, and the rotation ``camera_from_icrf``.

    Rotation and ``sky.camera`` are of the image mirrored left to right where it is a mirror image.
    ``quarter_turned``: the image has the sides of the prior camera exchanged, and was turned
    counterclockwise by 90 degrees.
    """

    time_ns: int
    sky: search.SkyMatch
    sources: BrightSources
    camera_from_icrf: Rotation
    quarter_turned: bool = False


@dataclass(frozen=True)
class Identified:
    """Images identified; sources of all images looked at; sizes (width, height) that differ."""

    solved: tuple[Solved, ...]
    seen: tuple[BrightSources, ...]
    other_sizes: tuple[tuple[int, int], ...]


@dataclass
class _Pending:
    time_ns: int
    sources: BrightSources
    quarter_turned: bool


Guesses = Callable[[int], Sequence[Rotation]]
"""Rotations ``camera_from_icrf`` that an image of a stamp may have, always in the same order."""


def identify_images(
    images: Iterable[Image],
    camera: CameraModel,
    catalog: StarCatalog,
    search_s: float = SEARCH_S,
    most: int = IMAGES,
    guesses: Guesses = lambda _: (),
) -> Identified:
    """
    The first images that can be identified, at most ``most``, in the order of their stamps.

    ``guesses`` are tried before the sky is searched.  The search ends ``search_s`` after its start
    at the latest, in processor time of this thread.
    """
    deadline_s = time.thread_time() + search_s
    solved: list[Solved] = []
    seen: list[BrightSources] = []
    other_sizes: list[tuple[int, int]] = []
    pending: list[_Pending] = []
    searched = 0
    for looked_at, image in enumerate(images, start=1):
        height, width = image.pixels.shape
        pixels, turned = image.pixels, False
        if (width, height) == (camera.height, camera.width) != (height, width):
            pixels, turned = np.ascontiguousarray(np.rot90(image.pixels)), True
        elif (width, height) != (camera.width, camera.height):
            other_sizes.append((width, height))
            if len(other_sizes) == _SEARCHED:
                break
            continue
        sources = bright_sources(pixels)
        seen.append(sources)
        # The pattern of streaks is none of points.
        if len(sources.xy_px) >= FEWEST_SOURCES and smear(sources) is None:
            one = _Pending(image.time_ns, sources, turned)
            searched += 1
            confirmed = _confirmed(one, guesses(one.time_ns), camera, catalog, solved)
            if confirmed is not None:
                solved.append(confirmed)
            elif not _search(one, search.ROUNDS[0], camera, catalog, solved, deadline_s):
                pending.append(one)
                if len(pending) == _FEW and not solved:
                    pending = _rescaled(pending, camera, catalog, solved, deadline_s)
        if len(solved) == most or searched == _SEARCHED or looked_at == LOOKED_AT:
            break
        if time.thread_time() > deadline_s:
            break
    for later in search.ROUNDS[1:]:
        left, pending = pending, []
        for one in left:
            if len(solved) >= min(_FEW, most) or time.thread_time() > deadline_s:
                break
            if not _search(one, later, camera, catalog, solved, deadline_s):
                pending.append(one)
    alike = _with_one_camera(solved, catalog)
    return Identified(
        tuple(sorted(alike, key=lambda one: one.time_ns)), tuple(seen), tuple(other_sizes)
    )


def _confirmed(
    one: _Pending,
    guessed: Sequence[Rotation],
    camera: CameraModel,
    catalog: StarCatalog,
    solved: Sequence[Solved],
) -> Solved | None:
    """An image identified by one of its guessed rotations."""
    ways = [solved[0].sky.mirrored] if solved else [False, True]
    for mirrored in ways:
        for rotation in guessed:
            sky = search.confirm_sky(one.sources.xy_px, camera, catalog, rotation, mirrored)
            if isinstance(sky, search.SkyMatch):
                return Solved(
                    one.time_ns, sky, one.sources, sky.camera_from_icrf, one.quarter_turned
                )
    return None


def _rescaled(
    pending: list[_Pending],
    camera: CameraModel,
    catalog: StarCatalog,
    solved: list[Solved],
    deadline_s: float,
) -> list[_Pending]:
    """The images that no focal length far from that of the camera identifies."""
    fx, fy = (float(camera.parameters[k]) for k in (0, 2))
    for scale in _OTHER_SCALES:
        tried = camera.replace(fx=scale * fx, fy=scale * fy)
        left = [
            one
            for one in pending
            if not _search(one, search.ROUNDS[0], tried, catalog, solved, deadline_s)
        ]
        if solved:
            return left
    return pending


def _search(
    one: _Pending,
    searched_round: tuple[int, int],
    camera: CameraModel,
    catalog: StarCatalog,
    solved: list[Solved],
    deadline_s: float,
) -> bool:
    """True if an image is identified, and is then among those solved."""
    xy_px = one.sources.xy_px
    rounds = (searched_round,)
    sky: search.SkyMatch | search.NotFound
    if not solved:
        sky = search.find_sky(
            xy_px, camera, catalog, try_mirrored=True, rounds=rounds, deadline_s=deadline_s
        )
    else:
        known = solved[0].sky
        focal_px = float(known.camera.parameters[0])
        prior = search.mirrored_camera(camera) if known.mirrored else camera
        sky = search.find_sky(
            search.mirror(xy_px, camera.width) if known.mirrored else xy_px,
            prior.replace(
                fx=focal_px,
                fy=focal_px * float(camera.parameters[2]) / float(camera.parameters[0]),
            ),
            catalog,
            rounds=rounds,
            deadline_s=deadline_s,
        )
        if isinstance(sky, search.SkyMatch) and known.mirrored:
            sky = dataclasses.replace(
                sky, mirrored=True, xy_px=search.mirror(sky.xy_px, camera.width)
            )
    if not isinstance(sky, search.SkyMatch):
        return False
    solved.append(Solved(one.time_ns, sky, one.sources, sky.camera_from_icrf, one.quarter_turned))
    return True


def _with_one_camera(solved: Sequence[Solved], catalog: StarCatalog) -> list[Solved]:
    """
    Images with the rotation that one camera for all gives.

    Each by itself cannot tell a rotation from a shift of the principal point.
    """
    if not solved:
        return []
    parameters = np.median([one.sky.camera.parameters for one in solved], axis=0)
    camera = dataclasses.replace(solved[0].sky.camera, parameters=parameters)
    return [
        dataclasses.replace(one, camera_from_icrf=_rotation(one.sky, camera, catalog))
        for one in solved
    ]


def _rotation(sky: search.SkyMatch, camera: CameraModel, catalog: StarCatalog) -> Rotation:
    """The rotation ``camera_from_icrf`` of an identified image with another camera."""
    xy_px = search.mirror(sky.xy_px, camera.width) if sky.mirrored else sky.xy_px
    seen = line_of_sight(camera, xy_px)
    stars = catalog.direction_icrs[sky.catalog_index]
    good = np.isfinite(seen[:, 0])
    limit_rad = _MISFIT_PX / float(camera.parameters[0])
    rotation = sky.camera_from_icrf
    for _ in range(2):
        if np.count_nonzero(good) < 3:
            return sky.camera_from_icrf
        rotation, _ = Rotation.align_vectors(seen[good], stars[good])
        apart = np.linalg.norm(rotation.apply(stars) - seen, axis=1)
        # A camera that fits all images on average may be some pixels off in one.
        good = apart < max(limit_rad, 2.0 * float(np.nanmedian(apart)))
    return rotation
