# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Reason why images match no stars: set-up and attitudes compared with the images alone.

Some images are identified without attitude or alignment, which gives the rotation of the camera.
With the recorded attitude it gives the alignment, under each convention that the attitude may
follow.  The right convention is the one with the same alignment in all images.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.camera import CameraModel
from starcal_ros.lost_in_space.bright_sources import bright_sources, BrightSources, smear
from starcal_ros.lost_in_space.search import find_sky, SkyMatch
from starcal_ros.pipeline.attitude_reading import (
    best_reading,
    CLOCK_SEARCH_S,
    in_words,
    is_off,
    off_by,
    Placed,
    Reading,
    readings,
    SetUp,
    WireAttitudes,
)
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog

CAUSES = (
    'none', 'mirrored', 'rotated', 'attitude_direction', 'quaternion_order', 'prior_alignment',
    'focal_length', 'clock', 'smear', 'no_stars', 'not_linear', 'unknown',
)  # fmt: skip

IMAGES = 8  # identified
_TRIED = 14  # looked at for them
_GIVEN_UP = 2  # looked at where none is identified
_FEWEST_SOURCES = 6
_ROTATED_RAD = math.radians(20.0)  # of a right angle about the line of sight
_FOCAL_SHARE = 0.03  # error of the focal length that an image is still matched with
_LINEAR_SLOPE = 0.65  # of brightness against that of the catalog; a display gamma of 2.2 has 0.45


@dataclass(frozen=True)
class Solved:
    """An image that was identified, and its sources."""

    time_ns: int
    sky: SkyMatch
    sources: BrightSources


@dataclass(frozen=True)
class Diagnosis:
    """
    Reason why images match no stars, with its evidence and its remedy.

    ``cause`` is one of `CAUSES`; ``found`` the value that was found, None if there is none;
    ``sentence`` states both, ``evidence`` lists the findings behind them, ``mend`` the lines of
    the parameter file that correct it.
    """

    cause: str
    found: float | str | list[float] | None
    sentence: str
    evidence: tuple[str, ...]
    mend: tuple[str, ...] = ()


def diagnose(
    images: Iterable[Image], attitudes: WireAttitudes, setup: SetUp, catalog: StarCatalog
) -> Diagnosis:
    """
    The cause that keeps the first images from matching, found from those images.

    The catalog is sorted by magnitude, as `load_catalog` gives it.
    """
    solved, seen = [], []
    for image in solve_images(images, setup.camera, catalog):
        if isinstance(image, Solved):
            solved.append(image)
            seen.append(image.sources)
        else:
            seen.append(image)
    if not solved:
        return _nothing_found(seen, setup)
    return _held_against(solved, len(seen), attitudes, setup, catalog)


def solve_images(
    images: Iterable[Image], camera: CameraModel, catalog: StarCatalog
) -> Iterator[Solved | BrightSources]:
    """Each image identified without attitude, or its sources; ends when enough are identified."""
    found: list[SkyMatch] = []
    prior = camera
    for tried, image in enumerate(images, start=1):
        height, width = image.pixels.shape
        sources = bright_sources(image.pixels)
        sky = None
        same_size = (width, height) == (camera.width, camera.height)
        if same_size and smear(sources) is None:  # streaks have no centroids for a pattern
            sky = find_sky(sources.xy_px, prior, catalog, try_mirrored=True)
        if isinstance(sky, SkyMatch):
            found.append(sky)
            yield Solved(image.time_ns, sky, sources)
        else:
            yield sources
        if len(found) == IMAGES or tried == _TRIED or (tried == _GIVEN_UP and not found):
            return


def _nothing_found(seen: Sequence[BrightSources], setup: SetUp) -> Diagnosis:
    """The cause where no image was identified."""
    counts = [len(sources.xy_px) for sources in seen]
    streaks = [streak for streak in map(smear, seen) if streak is not None]
    if not seen:
        return Diagnosis('no_stars', 0, 'There is no image that can be read.', ())
    looked = f'{len(seen)} images looked at, {int(np.median(counts))} star-like sources each'
    if 2 * len(streaks) > len(seen):
        length_px = float(np.median([length for length, _ in streaks]))
        return Diagnosis(
            'smear',
            round(length_px, 1),
            f'The stars are streaks about {length_px:.0f} px long: the camera moves during the'
            ' exposure.',
            (looked, 'the sources are more than twice as long as wide, and all point one way'),
            ('# no parameter mends this: expose for a shorter time, or while not slewing',),
        )
    if np.median(counts) < _FEWEST_SOURCES:
        level = float(np.median([s.background.level_dn for s in seen]))
        noise = float(np.median([s.background.noise_dn for s in seen]))
        return Diagnosis(
            'no_stars',
            int(np.median(counts)),
            'The images show too few stars.',
            (looked, f'background {level:.0f} DN with a noise of {noise:.1f} DN'),
            ('# no parameter mends this: expose for longer, or check that the lens sees the sky',),
        )
    focal_px = float(setup.camera.parameters[0])
    width_deg = math.degrees(2 * math.atan(setup.camera.width / 2 / focal_px))
    return Diagnosis(
        'unknown',
        None,
        'No image can be identified, and why was not found.',
        (
            looked,
            'no pattern of them is one of the sky, mirrored or not',
            f'tried: focal lengths within 25 % of {focal_px:.0f} px, {width_deg:.1f} deg wide',
        ),
        ('# check camera_info_url: focal length in pixels, size of the image',),
    )


def _held_against(
    solved: Sequence[Solved],
    tried: int,
    attitudes: WireAttitudes,
    setup: SetUp,
    catalog: StarCatalog,
) -> Diagnosis:
    """The cause where images were identified."""
    worst = max(image.sky.log10_p_value for image in solved)
    stars = [len(image.sky.xy_px) for image in solved]
    evidence = [f'{len(solved)} of {tried} images identified without attitude, {min(stars)} to']
    evidence[0] += f' {max(stars)} stars each; expected false matches: under 10^{worst:.0f} each'
    mirrored = sum(image.sky.mirrored for image in solved) * 2 > len(solved)
    alike = [
        Placed(image.time_ns, image.sky.camera_from_icrf)
        for image in solved
        if image.sky.mirrored == mirrored
    ]
    reading = best_reading(alike, attitudes, setup)
    if mirrored:
        return _mirrored(reading, setup, evidence)
    if reading is None:
        return _no_reading(attitudes, setup, evidence)
    evidence.append(
        f'read as {in_words(reading)}, the attitudes of {reading.agreeing} of {len(alike)} images'
        f' give one alignment to {math.degrees(reading.scatter_rad):.3f} degrees'
    )
    given = readings(alike, attitudes, setup, 0.0)[0]
    if reading is not given and given.agreeing < reading.agreeing:
        evidence.append(
            f'read as {in_words(given)}, as they are now, those of {given.agreeing} do'
        )
    quaternion = reading.star_tracker_from_camera.as_quat(canonical=True)
    values = [round(float(q), 7) for q in quaternion]
    mend = [f'prior_alignment: {values}'] if is_off(reading, setup) else []
    if reading.order == 'wxyz':
        direction = reading.direction
        if direction != setup.attitude_direction:
            mend.append(f'attitude_direction: {direction}')
        return Diagnosis(
            'quaternion_order',
            'wxyz',
            'The attitude quaternions are sent with w first; the message has x, y, z, w.',
            tuple(evidence),
            ('# no parameter mends this: send x, y, z, w in the fields of that name', *mend),
        )
    if reading.direction != setup.attitude_direction:
        return Diagnosis(
            'attitude_direction',
            reading.direction,
            f'The attitude quaternions are {in_words(reading)}, not {setup.attitude_direction}.',
            tuple(evidence),
            (f'attitude_direction: {reading.direction}', *mend),
        )
    if reading.shift_s:
        offset_s = round(setup.stamp_offset_s + reading.shift_s, 2)
        return Diagnosis(
            'clock',
            offset_s,
            f'The stamps of the images are {abs(reading.shift_s):.2f} s'
            f' {"behind" if reading.shift_s > 0 else "ahead of"} those of the attitudes.',
            (*evidence, 'the attitude at the shifted stamps gives one alignment, at others not'),
            (f'stamp_offset_s: {offset_s}', *mend),
        )
    if setup.star_tracker_from_camera is None or is_off(reading, setup):
        return _alignment_off(reading, setup, evidence, values)
    return _camera_off(solved, setup, catalog, evidence)


def _alignment_off(
    reading: Reading, setup: SetUp, evidence: list[str], values: list[float]
) -> Diagnosis:
    """The cause where only the alignment does not fit."""
    mend = (f'prior_alignment: {values}',)
    if setup.star_tracker_from_camera is None:
        sentence = 'prior_alignment is not given; the images show it.'
        return Diagnosis('prior_alignment', values, sentence, tuple(evidence), mend)
    tilt_rad, roll_rad = off_by(reading, setup)
    evidence.append(
        f'prior_alignment points {math.degrees(tilt_rad):.1f} degrees away from it and is rolled'
        f' by {math.degrees(roll_rad):.1f} degrees'
    )
    right_angles = round(roll_rad / (math.pi / 2))
    left_rad = abs(roll_rad - right_angles * math.pi / 2)
    if right_angles and left_rad < _ROTATED_RAD and tilt_rad < _ROTATED_RAD:
        degrees = (90 * right_angles) % 360
        return Diagnosis(
            'rotated',
            float(degrees),
            f'The image is rotated by {degrees} degrees against prior_alignment.',
            tuple(evidence),
            mend,
        )
    return Diagnosis(
        'prior_alignment',
        values,
        f'prior_alignment points {math.degrees(tilt_rad):.1f} degrees away from where the images'
        ' show the camera, and is rolled by'
        f' {math.degrees(roll_rad):.1f} degrees.',
        tuple(evidence),
        mend,
    )


def _mirrored(reading: Reading | None, setup: SetUp, evidence: list[str]) -> Diagnosis:
    """The cause where the images are mirror images."""
    evidence.append('the patterns of the sky are there when the image is mirrored, not as it is')
    how = 'left to right'
    if reading is not None and setup.star_tracker_from_camera is not None:
        _, roll_rad = off_by(reading, setup)
        if abs(roll_rad) > math.radians(135.0):
            how = 'top to bottom'
    return Diagnosis(
        'mirrored',
        how,
        f'The image is mirrored {how}.',
        tuple(evidence),
        (f'# no parameter mends this: mirror the images {how} where they are read out',),
    )


def _no_reading(attitudes: WireAttitudes, setup: SetUp, evidence: list[str]) -> Diagnosis:
    """The cause where no reading of the attitudes gives one alignment."""
    evidence.append(
        f'no reading of the {len(attitudes.time_ns)} attitudes, at shifts of up to'
        f' {CLOCK_SEARCH_S:.0f} s, gives one alignment for most of the images'
    )
    return Diagnosis(
        'unknown',
        None,
        'The stars of the images are identified, but the attitudes do not go with them.',
        tuple(evidence),
        ('# check that the attitudes are those of this spacecraft, star tracker and time',),
    )


def _camera_off(
    solved: Sequence[Solved], setup: SetUp, catalog: StarCatalog, evidence: list[str]
) -> Diagnosis:
    """The cause where attitudes and alignment fit: the focal length, the brightnesses, or none."""
    prior_px = float(setup.camera.parameters[0])
    by_stars = max(solved, key=lambda image: len(image.sky.xy_px))
    focal_px = float(np.median([image.sky.camera.parameters[0] for image in solved]))
    off = focal_px / prior_px - 1.0
    evidence.append(
        f'the images show a focal length of {focal_px:.1f} px, the prior {prior_px:.1f}'
    )
    if abs(off) > _FOCAL_SHARE:
        return Diagnosis(
            'focal_length',
            round(focal_px, 2),
            f'The focal length of the prior camera, {prior_px:.0f} px, is'
            f' {abs(100 * (prior_px / focal_px - 1)):.0f} %'
            f' too {"short" if off > 0 else "long"}.',
            tuple(evidence),
            (f'# in the file of camera_info_url: fx = fy = {focal_px:.1f}',),
        )
    slope = _brightness_slope(by_stars, catalog)
    if slope is not None and slope < _LINEAR_SLOPE:
        evidence.append(f'brightness grows with that of the catalog to the power {slope:.2f}')
        return Diagnosis(
            'not_linear',
            round(slope, 2),
            'The images are not linear in the light: they have been through a tone curve.',
            tuple(evidence),
            ('# no parameter mends this: record raw images',),
        )
    return Diagnosis(
        'none',
        None,
        'Attitudes, alignment and camera fit the images.',
        tuple(evidence),
    )


def _brightness_slope(image: Solved, catalog: StarCatalog) -> float | None:
    """Exponent of measured over catalog brightness of unsaturated stars; None with too few."""
    place = {tuple(xy): k for k, xy in enumerate(image.sources.xy_px.tolist())}
    rows = np.array([place.get(tuple(xy), -1) for xy in image.sky.xy_px.tolist()], np.int64)
    peak = image.sources.peak_dn
    good = (rows >= 0) & (peak[rows] < 0.8 * peak.max(initial=0.0))
    if np.count_nonzero(good) < 15:
        return None
    magnitude = catalog.magnitude[image.sky.catalog_index[good]]
    light = np.log10(image.sources.flux_dn[rows[good]])
    if np.ptp(magnitude) < 2.0:
        return None
    # Theil and Sen: outliers are variables, doubles and saturated stars.
    i, j = np.triu_indices(len(light), 1)
    far = np.abs(magnitude[i] - magnitude[j]) > 0.7
    return float(np.median((light[i] - light[j])[far] / (magnitude[j] - magnitude[i])[far]) / 0.4)
