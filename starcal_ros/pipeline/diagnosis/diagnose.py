# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Why the images of a set match no star: the set-up held against what the images show by themselves.

Some images are identified without attitude or alignment.  Each gives the true rotation of the
camera; with the attitude on the wire, read in one of the ways it can be meant, it gives the
alignment.  The right reading is the one whose alignment is the same for all images.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np

from starcal_ros.blas_threads import one_blas_thread
from starcal_ros.identification.blind.bright_sources import LONGEST_STREAK_PX, smear
from starcal_ros.pipeline.diagnosis.attitude_reading import (
    best_reading,
    CLOCK_SEARCH_S,
    expected_rotations,
    in_words,
    is_off,
    off_by,
    Placed,
    quarter_turns,
    Reading,
    readings,
    SetUp,
    WireAttitudes,
)
from starcal_ros.pipeline.diagnosis.identified import (
    FEWEST_SOURCES,
    Identified,
    identify_images,
    SEARCH_S,
    Solved,
)
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog

CAUSES = (
    'none', 'mirrored', 'rotated', 'attitude_direction', 'quaternion_order', 'prior_alignment',
    'focal_length', 'clock', 'smear', 'no_stars', 'not_linear', 'unknown',
)  # fmt: skip

_NO_PARAMETER = 'no parameter mends this: '
_SAME_DATE_S = 86400.0  # aberration changes by 0.35 arcsec in a day
_FOCAL_SHARE = 0.03  # error of the focal length that an image is still matched with
_LINEAR_SLOPE = 0.5  # of brightness against that of the catalog; a display gamma of 2.2 has 0.45
_SAME_ALIGNMENT_RAD = math.radians(3.0)  # of one written in another way and the one found


@dataclass(frozen=True)
class Diagnosis:
    """
    Why images match nothing.

    ``cause`` is one of `CAUSES` or a reason to refuse an image, ``also`` are others found with it;
    ``found`` the value that was found, None where there is none; ``sentence`` says both in words,
    ``evidence`` how it is known, ``mend`` are lines of the parameter file.  ``images`` agree on
    how the attitudes are meant.
    """

    cause: str
    found: float | str | list[float] | None
    sentence: str
    evidence: tuple[str, ...] = ()
    mend: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    images: int = 0

    def in_lines(self) -> list[str]:
        """The sentence, the evidence and the remedy, as lines for a terminal."""
        lines = [self.sentence, '', 'evidence:', *(f'  {line}' for line in self.evidence)]
        mend = ['', 'in the parameter file:', *(f'  {line}' for line in self.mend)]
        return lines + mend if self.mend else lines

    def in_a_sentence(self) -> str:
        """Cause and remedy, as the end of a complaint."""
        lines = '; '.join(line for line in self.mend if not line.startswith('#'))
        advice = [line.removeprefix('# ').removeprefix(_NO_PARAMETER) for line in self.mend]
        advice = [line for line in advice if line not in self.mend]
        said = [self.sentence, *([f'Set {lines}.'] if lines else [])]
        said += [f'{line[0].upper()}{line[1:]}.' for line in advice]
        return f'{" ".join(said)} (details: starcal diagnose)'


@one_blas_thread()
def diagnose(
    images: Iterable[Image],
    attitudes: WireAttitudes,
    setup: SetUp,
    catalog: StarCatalog,
    search_s: float = SEARCH_S,
) -> Diagnosis:
    """
    The cause that keeps the first images from matching, found from those images.

    The catalog is sorted by magnitude, as `load_catalog` gives it.  ``search_s`` limits the time
    that the identification may take.
    """
    guesses = functools.partial(expected_rotations, attitudes, setup)
    found = identify_images(images, setup.camera, catalog, search_s, guesses=guesses)
    if not found.solved:
        return _nothing_found(found, setup)
    return _held_against(found.solved, len(found.seen), attitudes, setup, catalog)


def _nothing_found(found: Identified, setup: SetUp) -> Diagnosis:
    """The cause where no image was identified."""
    seen = found.seen
    if not seen and found.other_sizes:
        return _of_another_size(found.other_sizes[0], setup)
    if not seen:
        return Diagnosis('no_stars', 0, 'There is no image that can be read.')
    counts = [len(sources.xy_px) for sources in seen]
    streaks = [streak for streak in map(smear, seen) if streak is not None]
    looked = f'{len(seen)} images looked at, {int(np.median(counts))} star-like sources each'
    if 2 * len(streaks) > len(seen):
        length_px = float(np.median([length for length, _ in streaks]))
        about = 'about' if length_px < LONGEST_STREAK_PX else 'at least'
        length_px = min(length_px, LONGEST_STREAK_PX)
        return Diagnosis(
            'smear',
            round(length_px, 1),
            f'The stars are streaks {about} {length_px:.0f} px long: the camera moves during the'
            ' exposure.',
            (looked, 'the sources are more than twice as long as wide, and all point one way'),
            ('# no parameter mends this: expose for a shorter time, or while not slewing',),
        )
    if np.median(counts) < FEWEST_SOURCES:
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
            'no pattern of them was found in the sky, mirrored or not, in the time of the search',
            f'tried: focal lengths of 0.25 to 4 times {focal_px:.0f} px, {width_deg:.1f} deg wide',
        ),
        ('# check camera_info_url: focal length in pixels, size of the image',),
    )


def _of_another_size(size: tuple[int, int], setup: SetUp) -> Diagnosis:
    """No cause can be named where the prior camera is of another image size."""
    camera = setup.camera
    return Diagnosis(
        'unknown',
        None,
        f'The images are {size[0]} x {size[1]}, the prior camera is of {camera.width} x'
        f' {camera.height}.',
        ('images of another size are of another camera, binned, or cut',),
        ('# in the file of camera_info_url: size of the images, focal length in their pixels',),
    )


def _held_against(
    solved: Sequence[Solved],
    tried: int,
    attitudes: WireAttitudes,
    setup: SetUp,
    catalog: StarCatalog,
) -> Diagnosis:
    """The causes where images were identified, the one that hides the others first."""
    worst = max(image.sky.log10_p_value for image in solved)
    stars = [len(image.sky.xy_px) for image in solved]
    chance = f'expected false matches: under 10^{worst:.0f} each'
    identified = f'{len(solved)} of {tried} images identified without attitude'
    evidence = [f'{identified}, {min(stars)} to {max(stars)} stars each; {chance}']
    placed = [Placed(image.time_ns, image.camera_from_icrf) for image in solved]
    reading = best_reading(placed, attitudes, setup)
    findings: list[Diagnosis | None] = []
    if solved[0].sky.mirrored:
        findings.append(_mirrored(reading, setup))
    if reading is not None:
        evidence += _agreement(reading, placed, attitudes, setup)
        findings += [_order(reading), _direction(reading, setup), _clock(reading, setup)]
        if solved[0].quarter_turned:
            findings.append(_sides_exchanged(reading, setup))
        elif not solved[0].sky.mirrored:
            findings.append(_alignment(reading, setup))
    elif not solved[0].sky.mirrored:
        findings.append(_no_reading(placed, attitudes, setup))
    findings += [_focal_length(solved, setup, evidence), _tone_curve(solved, catalog)]
    joined = _joined([one for one in findings if one is not None], evidence)
    return dataclasses.replace(joined, images=0 if reading is None else reading.agreeing)


def _joined(findings: Sequence[Diagnosis], evidence: list[str]) -> Diagnosis:
    """The first of the findings, with the remedies of all of them."""
    if not findings:
        sentence = 'Attitudes, alignment and camera fit the images.'
        return Diagnosis('none', None, sentence, tuple(evidence))
    first, *others = findings
    for one in findings:
        evidence += one.evidence
    evidence += [f'besides: {one.sentence}' for one in others]
    return dataclasses.replace(
        first,
        evidence=tuple(evidence),
        mend=tuple(line for one in findings for line in one.mend),
        also=tuple(one.cause for one in others),
    )


def _agreement(
    reading: Reading, placed: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp
) -> list[str]:
    """Evidence for a reading, and against the one set up where that is another."""
    alike = f'give one alignment to {math.degrees(reading.scatter_rad):.3f} degrees'
    of = f'{reading.agreeing} of {len(placed)} images'
    lines = [f'read as {in_words(reading)}, the attitudes of {of} {alike}']
    given = readings(placed, attitudes, setup, 0.0)[0]
    if (reading.order, reading.direction) != (given.order, given.direction):
        agree = f'those of {given.agreeing} agree to {math.degrees(given.scatter_rad):.3f} degrees'
        if given.agreeing < 2:
            agree = 'no two agree'
        lines.append(f'read as {in_words(given)}, as they are now, {agree}')
    return lines


def _order(reading: Reading) -> Diagnosis | None:
    """The order of the quaternion as a cause; None: it is right."""
    if reading.order == 'xyzw':
        return None
    return Diagnosis(
        'quaternion_order',
        'wxyz',
        'The attitude quaternions are sent with w first; the message has x, y, z, w.',
        mend=('# no parameter mends this: send x, y, z, w in the fields of that name',),
    )


def _direction(reading: Reading, setup: SetUp) -> Diagnosis | None:
    """The direction of the attitudes as a cause; None: it is right."""
    if reading.direction == setup.attitude_direction:
        return None
    return Diagnosis(
        'attitude_direction',
        reading.direction,
        f'The attitude quaternions are {in_words(reading)}, not {setup.attitude_direction}.',
        mend=(f'attitude_direction: {reading.direction}',),
    )


def _clock(reading: Reading, setup: SetUp) -> Diagnosis | None:
    """The stamps as a cause; None: they are right."""
    shift_s = setup.shift_s + reading.shift_s
    if not shift_s:
        return None
    offset_s = round(setup.stamp_offset_s + shift_s, 2)
    mend = [f'stamp_offset_s: {offset_s}']
    if abs(shift_s) > _SAME_DATE_S:
        mend.append('# that takes the date of the attitudes: if it is wrong, correct their stamps')
    return Diagnosis(
        'clock',
        offset_s,
        f'The stamps of the images are {abs(shift_s):.2f} s'
        f' {"behind" if shift_s > 0 else "ahead of"} those of the attitudes.',
        ('the attitude at the shifted stamps gives one alignment, at others not',),
        tuple(mend),
    )


def _alignment(reading: Reading, setup: SetUp) -> Diagnosis | None:
    """The prior alignment as a cause; None: it is near enough."""
    if not is_off(reading, setup):
        return None
    values = alignment_values(reading)
    mend = (f'prior_alignment: {values}',)
    prior = setup.star_tracker_from_camera
    if prior is None:
        sentence = 'prior_alignment is not given; the images show it.'
        return Diagnosis('prior_alignment', values, sentence, (), mend)
    tilt_deg, roll_deg = (math.degrees(angle) for angle in off_by(reading, setup))
    away = f'{tilt_deg:.1f} degrees away from it and is rolled by {roll_deg:.1f} degrees'
    evidence = [f'prior_alignment points {away}']
    turns = quarter_turns(reading, setup)
    if turns:
        degrees, way = {1: (90.0, ' counterclockwise'), 2: (180.0, ''), 3: (90.0, ' clockwise')}[
            turns
        ]
        return Diagnosis(
            'rotated',
            degrees,
            f'The image is rotated by {degrees:.0f} degrees{way} against prior_alignment.',
            tuple(evidence),
            mend,
        )
    found = reading.star_tracker_from_camera
    if (prior * found).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is the inverse of it: camera from star tracker')
    w_first = type(prior).from_quat(prior.as_quat()[[1, 2, 3, 0]])
    if (w_first.inv() * found).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is given with w first')
    return Diagnosis(
        'prior_alignment',
        values,
        f'prior_alignment points {tilt_deg:.1f} degrees away from where the images show the'
        f' camera, and is rolled by {roll_deg:.1f} degrees.',
        tuple(evidence),
        mend,
    )


def alignment_values(reading: Reading) -> list[float]:
    """The alignment of a reading as `prior_alignment` has it."""
    quaternion = reading.star_tracker_from_camera.as_quat(canonical=True)
    return [round(float(q), 7) for q in quaternion]


def _sides_exchanged(reading: Reading, setup: SetUp) -> Diagnosis:
    """The cause where the images have the sides of the prior camera exchanged."""
    upside_down = setup.star_tracker_from_camera is not None and quarter_turns(reading, setup) == 2
    way = 'counterclockwise' if upside_down else 'clockwise'
    back = 'clockwise' if upside_down else 'counterclockwise'
    return Diagnosis(
        'rotated',
        90.0,
        f'The image is rotated by 90 degrees {way}.',
        ('its sides are those of the prior camera exchanged',),
        (f'# no parameter mends this: turn the images {back} where they are read out',),
    )


def _mirrored(reading: Reading | None, setup: SetUp) -> Diagnosis:
    """The cause where the images are mirror images."""
    how = 'left to right'
    if reading is not None and setup.star_tracker_from_camera is not None:
        _, roll_rad = off_by(reading, setup)
        if abs(roll_rad) > math.radians(135.0):
            how = 'top to bottom'
    return Diagnosis(
        'mirrored',
        how,
        f'The image is mirrored {how}.',
        ('the patterns of the sky are there when the image is mirrored, not as it is',),
        (f'# no parameter mends this: mirror the images {how} where they are read out',),
    )


def _no_reading(placed: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp) -> Diagnosis:
    """No cause can be named where no reading of the attitudes is the right one."""
    several = [r for r in readings(placed, attitudes, setup, 0.0) if r.agreeing == len(placed)]
    if len(several) > 1:
        names = ' and '.join(in_words(reading) for reading in several)
        return Diagnosis(
            'unknown',
            None,
            'The stars are identified, but attitudes that do not turn leave open how they are'
            ' meant, and prior_alignment goes with no way to read them.',
            (f'the images give one alignment read as {names}',),
            ('# give a bag in which the spacecraft turns, or a prior_alignment to 1 degree',),
        )
    tried = (
        f'no reading of the {len(attitudes.time_ns)} attitudes, at shifts of up to'
        f' {CLOCK_SEARCH_S:.0f} s, gives one alignment for most of the images'
    )
    return Diagnosis(
        'unknown',
        None,
        'The stars of the images are identified, but the attitudes do not go with them.',
        (tried,),
        ('# check that the attitudes are those of this spacecraft, star tracker and time',),
    )


def _focal_length(solved: Sequence[Solved], setup: SetUp, evidence: list[str]) -> Diagnosis | None:
    """The focal length as a cause; None: it is near enough."""
    prior_px = float(setup.camera.parameters[0])
    focal_px = float(np.median([image.sky.camera.parameters[0] for image in solved]))
    evidence.append(
        f'the images show a focal length of {focal_px:.1f} px, the prior {prior_px:.1f}'
    )
    off = focal_px / prior_px - 1.0
    if abs(off) <= _FOCAL_SHARE:
        return None
    return Diagnosis(
        'focal_length',
        round(focal_px, 2),
        f'The focal length of the prior camera, {prior_px:.0f} px, is'
        f' {abs(100 * (prior_px / focal_px - 1)):.0f} %'
        f' too {"short" if off > 0 else "long"}.',
        mend=(f'# in the file of camera_info_url: fx = fy = {focal_px:.1f}',),
    )


def _tone_curve(solved: Sequence[Solved], catalog: StarCatalog) -> Diagnosis | None:
    """A tone curve as a cause; None: the images are linear, or show too few stars for it."""
    slope = _brightness_slope(max(solved, key=lambda image: len(image.sky.xy_px)), catalog)
    if slope is None or slope >= _LINEAR_SLOPE:
        return None
    return Diagnosis(
        'not_linear',
        round(slope, 2),
        'The images are not linear in the light: they have been through a tone curve.',
        (f'brightness grows with that of the catalog to the power {slope:.2f}',),
        ('# no parameter mends this: record raw images',),
    )


def _brightness_slope(image: Solved, catalog: StarCatalog) -> float | None:
    """Power of the catalog's brightness that unsaturated stars have; None: too few to tell."""
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
