# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Identification of the stars of one image without attitude or alignment.

Patterns of the brightest sources give candidates (`candidates`).  The best ones are refined, those
that are almost certain before all others; the first one with a significant p-value is accepted
(`sky_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import itertools
import math
import time

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel
from starcal_ros.identification.blind.candidates import Candidates, focal_scales, look_up, View
from starcal_ros.identification.blind.pattern_index import scales_for
from starcal_ros.identification.blind.sky_fit import (
    FOUND,
    log10_p_value,
    mutual,
    predicted,
    Ranges,
    refined,
    SkyFit,
    SourceImage,
    STATED,
)
from starcal_ros.sky.catalog import StarCatalog

MAX_LOG10_P_VALUE = -3.0  # a bound, some orders of magnitude above the rate of false matches
ROUNDS = ((0, 12), (12, 18), (18, 24))
"""
(first, last) of each round: patterns of the ``last`` brightest sources, with at least one source
after the ``first`` brightest.
"""
_GUESSED = 0.2  # largest shift of a guess, half diagonals
_ALIKE = 0.03  # largest shift of one star to the next, half diagonals
_OF_A_GUESS = 40  # brightest stars and sources compared with a guess
_FEWEST_SOURCES = 5
_AGAIN_PX = 3.0  # radius of matching with a better camera


@dataclass(frozen=True)
class SkyMatch:
    """
    Identified stars of an image.

    Attributes
    ----------
    camera_from_icrf : Rotation
        From catalog directions (ICRS, epoch of the catalog) to camera axes; no aberration applied.
    camera : CameraModel
        The prior with focal length, principal point and ``k1`` fitted to these stars.
    catalog_index : (n,)
        Rows of the catalog.
    xy_px : (n, 2)
        Pixels of those stars, as given.
    mirrored : bool
        The image is a mirror image; rotation and camera are for the image mirrored left to right.
    log10_p_value : float
        Decadic logarithm of the expected number of false matches this good.
    residual_px : float
        Root mean square of the residuals, per axis.
    """

    camera_from_icrf: Rotation
    camera: CameraModel
    catalog_index: Indices
    xy_px: Floats
    mirrored: bool
    log10_p_value: float
    residual_px: float

    @property
    def camera_px(self) -> Floats:
        """Pixels (n, 2) in the image that ``camera`` is of: mirrored where that is."""
        return mirror(self.xy_px, self.camera.width) if self.mirrored else self.xy_px


@dataclass(frozen=True)
class NotFound:
    """Reason why no stars were identified, and the log10 p-value of the best fit, if any."""

    reason: str
    log10_p_value: float = math.inf


def find_sky(
    xy_px: Floats, camera: CameraModel, catalog: StarCatalog, try_mirrored: bool = False
) -> SkyMatch | NotFound:
    """
    Identified stars among sources (n, 2), brightest first, or the reason why there are none.

    ``camera`` is the prior: focal length within 25 %, principal point within 5 % of the width,
    distortion within 3 % of the radius.  The catalog is sorted by magnitude.  With
    ``try_mirrored`` the mirror image is searched too.
    """
    return find_in_any([xy_px], camera, catalog, (False, True) if try_mirrored else (False,))[0]


def find_in_any(
    rankings: Sequence[Floats],
    camera: CameraModel,
    catalog: StarCatalog,
    mirrored: Sequence[bool] = (False,),
    rounds: Sequence[tuple[int, int]] = ROUNDS,
    deadline_s: float = math.inf,
    ranges: Ranges = STATED,
) -> tuple[SkyMatch | NotFound, int]:
    """
    As `find_sky` for several selections of the sources of an image; the row of the matched.

    ``mirrored`` are the ways that each is tried, ``rounds`` a part of `ROUNDS`, ``ranges`` those
    of the camera.  The search ends when the processor time of the thread reaches ``deadline_s``.
    """
    seen = [
        _Seen(_image(xy_px, camera, turned, ranges), turned, k)
        for k, xy_px in enumerate(rankings)
        if len(xy_px) >= _FEWEST_SOURCES
        for turned in mirrored
    ]
    if not seen:
        count = max(len(xy_px) for xy_px in rankings)
        return NotFound(f'{count} star-like sources, at least {_FEWEST_SOURCES} are needed'), 0
    tried = math.log10(len(mirrored))
    least = math.inf
    for before, sources in rounds:
        chosen = [one for one in seen if len(one.image.xy_px) > before]
        for one, candidates in _candidates(chosen, catalog, before, sources):
            for fit in _fits(one.image, catalog, candidates):
                log10_p, radius_px = log10_p_value(one.image, catalog, fit)
                log10_p += tried
                least = min(least, log10_p)
                if log10_p < MAX_LOG10_P_VALUE:
                    result = _result(one.image, catalog, fit, radius_px, log10_p, one.mirrored)
                    return result, one.ranking
            if time.thread_time() > deadline_s:
                return NotFound('the search has reached its time limit', least), 0
    return NotFound('no pattern of the sources matches the catalog beyond chance', least), 0


@dataclass(frozen=True)
class _Seen:
    """A selection of the sources of an image, as given or mirrored left to right."""

    image: SourceImage
    mirrored: bool
    ranking: int


def _image(xy_px: Floats, camera: CameraModel, mirrored: bool, ranges: Ranges) -> SourceImage:
    """Sources (n, 2) with a prior camera, or those of the mirror image."""
    if not mirrored:
        return SourceImage(xy_px, camera, ranges)
    return SourceImage(mirror(xy_px, camera.width), mirrored_camera(camera), ranges)


def _candidates(
    seen: Sequence[_Seen], catalog: StarCatalog, before: int, sources: int
) -> Iterator[tuple[_Seen, Candidates]]:
    """
    Candidates of all look-ups: first the almost certain ones of each, then the others.

    To refine a false candidate costs half as much as a look-up, and there may be 32 of them.
    """
    others = []
    scales = focal_scales(seen[0].image) if seen else ()
    for focal_scale, one in itertools.product(scales, seen):
        view = View(one.image, focal_scale)
        patterns = view.patterns(before, sources)
        for scale in scales_for(one.image.half_diagonal_rad / focal_scale):
            certain, other = look_up(view, catalog, scale, patterns).in_two()
            yield one, certain
            others.append((one, other))
    yield from others


def confirm_sky(
    xy_px: Floats,
    camera: CameraModel,
    catalog: StarCatalog,
    camera_from_icrf: Rotation,
    mirrored: bool = False,
    ranges: Ranges = STATED,
) -> SkyMatch | NotFound:
    """Identified stars, as from `find_sky`, given a rotation known to 10 % of the field."""
    image = _image(xy_px, camera, mirrored, ranges)
    stars = _stars_about(image, catalog, camera_from_icrf.as_matrix()[2])
    start = SkyFit(camera_from_icrf, image.camera, stars)
    pairs = _shifted_alike(image, catalog, start)
    fit = refined(image, catalog, start, pairs) if len(pairs) >= 5 else None
    if fit is None:
        return NotFound('the stars are not where they were expected')
    log10_p, radius_px = log10_p_value(image, catalog, fit)
    if log10_p >= MAX_LOG10_P_VALUE:
        return NotFound('the stars are not where they were expected', log10_p)
    return _result(image, catalog, fit, radius_px, log10_p, mirrored)


def matched_again(
    sky: SkyMatch, xy_px: Floats, catalog: StarCatalog, camera: CameraModel, rotation: Rotation
) -> SkyMatch:
    """A match with all its stars among sources (n, 2) by a better camera and rotation."""
    turned_px = mirror(xy_px, camera.width) if sky.mirrored else xy_px
    image = SourceImage(turned_px, camera, FOUND)
    fit = SkyFit(rotation, camera, _stars_about(image, catalog, rotation.as_matrix()[2]))
    return _result(image, catalog, fit, _AGAIN_PX, sky.log10_p_value, sky.mirrored)


def _shifted_alike(image: SourceImage, catalog: StarCatalog, start: SkyFit) -> Indices:
    """Pairs (k, 2) of catalog row and source whose shifts are the most alike."""
    stars, xy_px = predicted(catalog, start, _OF_A_GUESS)
    shift = (image.xy_px[None, :_OF_A_GUESS] - xy_px[:, None]) / image.half_diagonal_px
    rank, source = np.nonzero(np.hypot(shift[..., 0], shift[..., 1]) < _GUESSED)
    if len(rank) == 0:
        return np.empty((0, 2), np.int64)
    tree = cKDTree(shift[rank, source])
    fullest = tree.query_ball_point(tree.data, _ALIKE, return_length=True).argmax()
    chosen = np.array(tree.query_ball_point(tree.data[fullest], _ALIKE))
    return np.stack([stars[rank[chosen]], source[chosen]], axis=-1)


def mirror(xy_px: Floats, width: int) -> Floats:
    """Pixels (n, 2) of an image mirrored left to right."""
    return np.stack([width - 1 - xy_px[:, 0], xy_px[:, 1]], axis=-1)


def mirrored_camera(camera: CameraModel) -> CameraModel:
    """Camera of the image mirrored left to right."""
    skew, cx = float(camera.parameters[1]), float(camera.parameters[3])
    turned = camera.replace(cx=camera.width - 1 - cx, skew=-skew)
    if 'p2' not in camera.parameter_names:
        return turned
    return turned.replace(p2=-float(camera.parameters[9]))


def _fits(image: SourceImage, catalog: StarCatalog, candidates: Candidates) -> Iterator[SkyFit]:
    """Refined fits of candidates in their order."""
    fx, fy = image.camera.parameters[[0, 2]]
    for k, scale in enumerate(candidates.focal_scale.tolist()):
        rotation = candidates.rotation[k]
        start = SkyFit(
            Rotation.from_matrix(rotation),
            image.camera.replace(fx=scale * float(fx), fy=scale * float(fy)),
            _stars_about(image, catalog, rotation[2]),
        )
        pairs = np.stack([candidates.stars[k], candidates.sources[k]], axis=-1)
        fit = refined(image, catalog, start, pairs)
        if fit is not None:
            yield fit


def _stars_about(image: SourceImage, catalog: StarCatalog, axis: Floats) -> Indices:
    """Rows of the stars that may be in the image with this axis, at least three per source."""
    radius_rad = 1.25 * image.half_diagonal_rad * (1 + image.ranges.focal)
    near = np.flatnonzero(catalog.direction_icrs @ axis > math.cos(min(radius_rad, 1.4)))
    area = 1.0 / (1.0 - math.cos(min(radius_rad, 1.4))) * (1.0 - math.cos(image.half_diagonal_rad))
    return near[: int(max(60, 3 * len(image.xy_px)) / area)]


def _result(
    image: SourceImage,
    catalog: StarCatalog,
    fit: SkyFit,
    radius_px: float,
    log10_p: float,
    mirrored: bool,
) -> SkyMatch:
    """Result of a fit with all sources that match it."""
    # Stars fainter than the sources would match only false ones.
    deepest = 2 * len(image.xy_px)
    stars, placed_px = predicted(catalog, fit, deepest)
    rank, source, apart_px = mutual(image, placed_px, max(radius_px, 1.5), 10_000)
    xy_px = image.xy_px[source]
    return SkyMatch(
        camera_from_icrf=fit.camera_from_icrf,
        camera=fit.camera,
        catalog_index=stars[rank],
        xy_px=mirror(xy_px, image.camera.width) if mirrored else xy_px,
        mirrored=mirrored,
        log10_p_value=log10_p,
        residual_px=float(np.sqrt(0.5 * (apart_px**2).mean())),
    )
