# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Identification of sources with stars under a large error of the prior alignment.

Bright sources and bright predictions vote for a common shift and roll; then rotation, scale and a
smooth correction are fitted, and the match is tested against the hypothesis of chance.  An image
without a significant match is refused.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import bdtr, pdtrc

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.camera import CameraModel, line_of_sight, project, rotation_jacobian
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.prediction import (
    fit_warp,
    in_image,
    Prediction,
    warp_degree,
    window_area,
)
from starcal_ros.robust_statistics import median, medians
from starcal_ros.stars.detection import Sources
from starcal_ros.text import counted

# Number of the brightest predictions and sources that vote; all pairs fill one histogram.
_VOTERS = 100
# If noise or artefacts outnumber the stars, only the brightest sources are stars.
_DEPTHS = (60, 30, 15)
_PAIRS_OF_CUBIC = 8  # fewest pairs with which a cubic radial distortion is fitted too
_MOST_CUBIC = 0.15  # its largest displacement in the corner of the image, half diagonals
_SOUND_SHARE = 0.75  # share of the brightest sources whose match needs no other attempt
_MET_PX = 2.0  # largest distance between a source and its star
_FEWEST_SOURCES = 5  # fewer cannot pass the test against chance
_SCALE_RANGE, _MOST_SCALE = 0.75, 1.3  # limits of the focal length over the prior
_SIDE = 3  # parts of the image along each side, in which a match must hold
PARTS = _SIDE**2
_FEWEST_IN_PART = 4  # points in a part for a significant share
_PART_MAX_P_VALUE = 1e-3  # p-value of the misses in a part, given a right match
_LOOKS = 10.0  # number of independent tests among depths, which share most stars
_MAX_P_VALUE = 1e-9  # p-value of the matched stars, given a wrong match


def acquire(prediction: Prediction, sources: Sources, reach_px: float, roll_rad: float) -> Floats:
    """
    Predicted pixels (n, 2) corrected to match the sources of the image.

    The prediction error is at most ``reach_px`` and a roll of ``roll_rad``.

    Raises ImageRefused ``no_match`` if the number of matched predictions is consistent with
    chance.
    """
    best_px, most, refused = None, -1, None
    count = len(sources.snr)
    for depth in (count, *(depth for depth in _DEPTHS if depth < count)):
        if depth < _FEWEST_SOURCES:
            continue
        brightest = sources.select(slice(depth))
        try:
            turn = _vote(prediction, brightest, reach_px, roll_rad)
            found_px = _match(prediction, brightest, turn, (reach_px, roll_rad))
        except ImageRefused as error:
            # The first attempt uses every source: its numbers describe the image.
            refused = refused or error
            continue
        inside = in_image(found_px, prediction.camera)
        brightest_px = found_px[inside][: 2 * _DEPTHS[0]]
        met = len(_pairs(brightest_px, sources.xy_px[: _DEPTHS[0]], _MET_PX))
        if met > most:
            best_px, most = found_px, met
        if most >= _SOUND_SHARE * min(len(sources.snr), _DEPTHS[0]):
            break
    if best_px is None:
        raise refused or ImageRefused('no_match', counted(len(sources.snr), 'star-like source'))
    return best_px


def _vote(prediction: Prediction, sources: Sources, reach_px: float, roll_rad: float) -> Rotation:
    """
    Small rotation of the camera frame that moves the predictions near their sources.

    For each roll within the limit, the pixel offsets of all pairs of bright sources and bright
    predictions are counted in cells; true pairs share one cell, false ones are spread.

    Raises ImageRefused ``no_match`` if the count of the best cell is consistent with chance.
    """
    camera = prediction.camera
    half_diagonal_px = 0.5 * np.hypot(camera.width, camera.height)
    # Large enough for the errors of the prior focal length and the roll step at the edge, but
    # small against the search range: a cell as large as the range would count everything.
    cell_px = min(max(3.0, 0.008 * half_diagonal_px), reach_px / 4)
    half_cells = int(np.ceil(reach_px / cell_px)) + 1
    roll_step = cell_px / half_diagonal_px
    roll_steps = int(np.ceil(roll_rad / roll_step))
    # Smallest first: among equal votes the smallest rotation wins.
    rolls_rad = [k * roll_step for k in sorted(range(-roll_steps, roll_steps + 1), key=abs)]

    centre = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    # Predictions fill the image and a margin about it: as many take part as put about twice the
    # number of the sources into an image of a window up to twice its area, and once in a larger.
    window = window_area(camera, reach_px)
    count = min(_VOTERS, 2 * len(sources.snr)) * max(1.0, window / 2.0)
    in_window = in_image(prediction.xy_px, camera, reach_px)
    stars = prediction.xy_px[in_window][: int(count)] - centre
    seen = sources.xy_px[:_VOTERS] - centre
    votes, roll, low = _fullest_block(stars, seen, cell_px, half_cells, rolls_rad)
    expected = len(stars) * len(seen) * (2 * cell_px) ** 2 / sources.searched_px2 / window
    trials = len(rolls_rad) * (2 * half_cells + 1) ** 2
    if votes < 4 or pdtrc(votes - 1, expected) * trials > 1e-2:
        raise ImageRefused(
            'no_match',
            f'{votes} of {min(len(stars), len(seen))} bright stars agree, consistent with chance',
        )
    offset = seen[:, None] - _rotated(stars, roll)[None]
    in_block = ((offset >= low) & (offset < low + 2 * cell_px)).all(axis=2)
    shift_px = medians(offset[in_block])
    middle = line_of_sight(camera, np.stack([centre, centre + shift_px]))
    axis = np.cross(middle[0], middle[1])
    return Rotation.from_rotvec(axis) * Rotation.from_rotvec([0.0, 0.0, roll])


def _fullest_block(
    stars_px: Floats, sources_px: Floats, cell_px: float, half_cells: int, rolls_rad: list[float]
) -> tuple[int, float, Floats]:
    """
    Votes of the fullest block of two by two cells, its roll and its lower corner (2,), px.

    ``stars_px`` (n, 2) and ``sources_px`` (m, 2) are relative to the centre of the roll.
    """
    cells = 2 * half_cells + 1
    most, best_roll, best = -1, 0.0, (0, 0)
    for roll in rolls_rad:
        offset = sources_px[:, None] - _rotated(stars_px, roll)[None]
        cell = np.floor(offset / cell_px).astype(np.int64).reshape(-1, 2) + half_cells
        inside = ((cell >= 0) & (cell < cells)).all(axis=1)
        flat = cell[inside, 1] * cells + cell[inside, 0]
        votes = np.bincount(flat, minlength=cells * cells).reshape(cells, cells)
        blocks = votes[:-1, :-1] + votes[1:, :-1] + votes[:-1, 1:] + votes[1:, 1:]
        k = int(blocks.argmax())
        if blocks.flat[k] > most:
            most, best_roll = int(blocks.flat[k]), roll
            best = k % (cells - 1), k // (cells - 1)
    return most, best_roll, (np.array(best) - half_cells) * cell_px


def _rotated(xy_px: Floats, angle_rad: float) -> Floats:
    """Points (n, 2) rotated about the origin from +u towards +v."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(xy_px @ np.array([[c, s], [-s, c]]))


def _pairs(predicted_px: Floats, sources_px: Floats, radius_px: float) -> Indices:
    """
    Pairs (k, 2) of prediction and source that are mutual nearest neighbours within a radius.

    No source and no star is used twice.
    """
    if len(predicted_px) == 0 or len(sources_px) == 0:
        return np.empty((0, 2), np.int64)
    distance, source = cKDTree(sources_px).query(predicted_px, distance_upper_bound=radius_px)
    star = np.nonzero(np.isfinite(distance))[0]
    _, back = cKDTree(predicted_px).query(sources_px[source[star]])
    mutual = back == star
    return np.stack([star[mutual], source[star[mutual]]], axis=-1)


def _refine_rotation(
    prediction: Prediction,
    sources: Sources,
    start: Rotation,
    stars: Indices,
) -> tuple[Floats, Indices]:
    """
    Predicted pixels (n, 2) after a fit of rotation and focal scale, and the pairs (k, 2).

    Robust Gauss-Newton on the small rotation and one common scale with a decreasing matching
    radius; only ``stars`` (rows of the prediction) are matched to the sources.
    """
    camera = prediction.camera
    centre = camera.parameters[3:5]
    half_diagonal_px = 0.5 * np.hypot(camera.width, camera.height)
    rotation, scale, cubic = start, 1.0, 0.0
    pairs: Indices = np.empty((0, 2), np.int64)

    def placed() -> tuple[Floats, Floats, Floats]:
        directions = rotation.apply(prediction.direction_camera)
        from_centre = project(camera, directions) - centre
        radius2 = np.minimum((from_centre**2).sum(axis=1) / half_diagonal_px**2, 2.0)[:, None]
        xy = centre + from_centre * (scale + cubic * radius2)
        return xy, directions, np.stack([from_centre, from_centre * radius2], axis=-1)

    widest = max(8.0, 0.012 * 2 * half_diagonal_px)
    for radius_px in (widest, widest, widest, widest / 2, widest / 2, widest / 3, widest / 3):
        xy, directions, by_radial = placed()
        pairs = _pairs(xy[stars], sources.xy_px, radius_px)
        if len(pairs) < 4:
            break
        star = stars[pairs[:, 0]]
        residual = sources.xy_px[pairs[:, 1]] - xy[star]
        J_rotation = rotation_jacobian(camera, directions[star])
        J = np.concatenate([scale * J_rotation, by_radial[star]], axis=-1)
        size = np.linalg.norm(residual, axis=1)
        weight = 1.0 / (1.0 + (size / max(median(size), 0.3)) ** 2)
        root = np.sqrt(weight)[:, None]
        free = 5 if len(pairs) >= _PAIRS_OF_CUBIC else 4
        step = np.linalg.lstsq(
            (J[:, :, :free] * root[:, :, None]).reshape(-1, free),
            (residual * root).ravel(),
            rcond=1e-10,
        )[0]
        rotation = Rotation.from_rotvec(-step[:3]) * rotation
        scale = float(np.clip(scale + step[3], _SCALE_RANGE, _MOST_SCALE))
        if free == 5:
            cubic = float(np.clip(cubic + step[4], -_MOST_CUBIC, _MOST_CUBIC))
    return placed()[0], pairs


def _match(
    prediction: Prediction,
    sources: Sources,
    rotation: Rotation,
    reach: tuple[float, float],
) -> Floats:
    """
    Predicted pixels (n, 2) refined to match the sources; ``reach`` of the search, px and rad.

    Raises ImageRefused ``no_match`` if the number of matched predictions is consistent with
    chance.
    """
    camera = prediction.camera
    # Equal numbers of predictions and sources: the fainter surplus has no counterpart.
    margin_px = 0.02 * np.hypot(camera.width, camera.height)
    turned_px = project(camera, rotation.apply(prediction.direction_camera))
    with np.errstate(invalid='ignore'):
        bright = np.flatnonzero(in_image(turned_px, camera, margin_px))
    bright = bright[: min(4 * len(sources.snr), 400)]
    seen = sources.select(slice(4 * len(bright)))
    xy, pairs = _refine_rotation(prediction, seen, rotation, bright)
    half_px = 0.5 * max(camera.width, camera.height)
    for radius_px in (max(4.0, 0.003 * half_px * 2), 3.0, 2.0):
        if len(pairs) < 4:
            break
        correction, _ = fit_warp(
            xy[bright[pairs[:, 0]]], seen.xy_px[pairs[:, 1]], np.full(len(pairs), 0.2), xy, half_px
        )
        pairs = _pairs((xy + correction)[bright], seen.xy_px, radius_px)
    if len(pairs) >= 4:
        xy = xy + correction
    # Rotation, scale, cubic and warp were fitted: two parameters can make one false pair match.
    degree = warp_degree(len(pairs))
    false_pairs = 3 + (degree + 1) * (degree + 2) // 2
    places = _places(camera, len(pairs), *reach)
    _check_beyond_chance(xy[bright], seen, false_pairs, places, camera)
    return xy


def _places(camera: CameraModel, pairs: int, reach_px: float, roll_rad: float) -> float:
    """
    Number of fits within the reach of a search that differ by the radius of a match.

    Infinite for fits with a warp, whose freedom is the number of false pairs that it can make.
    """
    if warp_degree(pairs) > 0:
        return np.inf
    half_diagonal_px = 0.5 * np.hypot(camera.width, camera.height) / _MET_PX
    scales = (_MOST_SCALE - _SCALE_RANGE) * half_diagonal_px
    cubics = 2 * _MOST_CUBIC * half_diagonal_px if pairs >= _PAIRS_OF_CUBIC else 1.0
    shifts = (2.0 * reach_px / _MET_PX) ** 2
    return float(shifts * max(1.0, 2.0 * roll_rad * half_diagonal_px) * scales * cubics)


def _check_beyond_chance(
    predicted_px: Floats,
    sources: Sources,
    false_pairs: int,
    places: float,
    camera: CameraModel,
) -> None:
    """
    Refuse the match if the number of predictions (n, 2) on a source is consistent with chance.

    ``false_pairs`` is the number of false pairs that the fit itself can make, ``places`` the
    number of different fits.  Each gives a bound of the probability of a false match.

    Raises ImageRefused ``no_match``.
    """
    inside = in_image(predicted_px, camera)
    radius_px = _MET_PX
    met = _pairs(predicted_px[inside], sources.xy_px, radius_px)
    matched = len(met)
    density = len(sources.snr) / sources.searched_px2
    tried = int(np.count_nonzero(inside))
    expected = tried * -np.expm1(-density * np.pi * radius_px**2)
    p_value = pdtrc(matched - 1 - false_pairs, expected) if matched > false_pairs else 1.0
    if np.isfinite(places) and matched >= _FEWEST_SOURCES:
        # The matched ones may be the brightest of all that are predicted: any depth counts.
        depth = np.sort(met[:, 0])[_FEWEST_SOURCES - 1 :] + 1
        chance = pdtrc(np.arange(_FEWEST_SOURCES, matched + 1) - 1, depth / tried * expected)
        p_value = min(p_value, _LOOKS * places * float(chance.min()))
    if matched < _FEWEST_SOURCES or p_value > _MAX_P_VALUE:
        raise ImageRefused(
            'no_match',
            f'{matched} of {tried} predicted stars match a source, {expected:.0f} expected by'
            ' chance',
        )
    if _matched_in_part(sources, met[:, 1], camera):
        raise ImageRefused('no_match', 'stars match in one part of the image only')


def _matched_in_part(sources: Sources, met: Indices, camera: CameraModel) -> bool:
    """
    Return True if bright sources are matched in one part of the image but not in most others.

    ``met`` are the matched sources.  In a crowded field a match with a wrong scale or distortion
    can hold in one part and still pass the test over the whole image.  A part without sources,
    e.g. behind a cloud, is not counted.
    """
    bright = sources.snr >= median(sources.snr[met])
    meets = np.zeros(len(sources.snr), bool)
    meets[met] = True
    part = part_of(sources.xy_px, (camera.height, camera.width))
    shown = np.bincount(part[bright], minlength=PARTS)
    found = np.bincount(part[bright & meets], minlength=PARTS)
    missed = missed_parts(shown, found)
    return bool(2 * np.count_nonzero(missed) > np.count_nonzero(shown >= _FEWEST_IN_PART))


def part_of(xy_px: Floats, shape: tuple[int, ...]) -> Indices:
    """Index (n,), 0 to `PARTS` - 1, of the part of the image that holds each point (n, 2)."""
    height, width = shape
    cell = np.clip((xy_px * _SIDE / [width, height]).astype(np.int64), 0, _SIDE - 1)
    return np.asarray(cell[:, 1] * _SIDE + cell[:, 0])


def best_share(shown: Indices, found: Indices) -> float:
    """Largest share over all parts of the points found (PARTS,) among those shown (PARTS,)."""
    return float((found / (shown + 1.0)).max(where=shown >= _FEWEST_IN_PART, initial=0.0))


def missed_parts(shown: Indices, found: Indices) -> Mask:
    """Mask (PARTS,) of the parts with a much smaller share of points found than the best part."""
    conclusive = shown >= _FEWEST_IN_PART
    if np.count_nonzero(conclusive) < 2:
        return np.zeros_like(conclusive)
    best = best_share(shown, found)
    # A factor of three: one cosmic ray makes several sources in one place.
    few = (bdtr(found, shown, best) < _PART_MAX_P_VALUE) & (found < best / 3 * shown)
    return np.asarray(conclusive & few)
