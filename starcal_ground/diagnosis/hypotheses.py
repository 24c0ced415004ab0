# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Possible mistakes of a set-up, each with what it needs and how the stars test it.

`HYPOTHESES` is the table.  Each test is one function below; it returns None where nothing is
wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.diagnosis.attitude_readings import (
    CLOCK_SEARCH_S,
    IMAGES_OF_A_READING,
    prior_alignment,
    Reading,
    W_FIRST,
    XYZW,
)
from starcal_ground.diagnosis.image_size import (
    centre_of_region,
    numbers_of_file,
    OF_FILE,
    size_of_file,
    sizes_in_words,
)
from starcal_ground.diagnosis.shown import Shown, SIGMAS, StarShape
from starcal_ros.pipeline.setup import Setup

NO_PARAMETER = 'no parameter mends this: '
FOCAL_SHARE = 0.03  # error of the focal length that an image is still matched with
HALF_OF_IMAGE = 0.5  # range, widths, of a principal point that is free
_SAME_DATE_S = 86400.0  # aberration changes by 0.35 arcsec in a day
# Power of the light of the catalog that pixel values follow: 0.45 after a display gamma of 2.2,
# 2.2 where one was undone that was not there.
# Linear cameras of seven kinds follow 0.73 to 1.23.
_LINEAR_SLOPES = 0.5, 1.6
_SHARP_PX = 1.2  # longest 1-sigma extent; longer stars lose light that is below the noise
_NOT_SHARP_PX = 2.0  # least extent blamed; discs and rings of less than 2.2 px were measured
_SAME_ALIGNMENT_RAD = math.radians(3.0)  # notations of one alignment differ by less
# Differences of clocks that people mix up, s, with an error of a shift.
_CLOCKS = {37.0: 'TAI - UTC', 18.0: 'GPS time - UTC', 69.184: 'TT - UTC', 32.184: 'TT - TAI'}
_SAME_CLOCK_S, _ZONE_S = 0.2, 900.0


@dataclass(frozen=True)
class Finding:
    """
    A mistake that the stars show, as `Diagnosis` has it.

    ``found`` is the value found, None where there is none; ``mend`` are lines of the parameter
    file.
    """

    found: float | str | list[float] | None
    sentence: str
    mend: tuple[str, ...]
    evidence: tuple[str, ...] = ()


class Hypothesis(NamedTuple):
    """
    A possible mistake, as `Diagnosis.cause`; what it needs to be tested; and the test.

    One that is ``alone`` is tested only where no other is found.
    """

    cause: str
    needs: Callable[[Shown], bool]
    test: Callable[[Shown], Finding | None]
    alone: bool = False


def _always(shown: Shown) -> bool:
    return True


def _is_read(shown: Shown) -> bool:
    return shown.reading is not None


def _lacks_attitudes(shown: Shown) -> bool:
    return shown.setup.has_tracker and not shown.has_attitudes


def _is_not_read(shown: Shown) -> bool:
    return shown.has_attitudes and shown.reading is None and not shown.is_mirrored


def _states_camera(shown: Shown) -> bool:
    return shown.states_camera


def _is_aligned_by(shown: Shown) -> bool:
    """True if the alignment shown can be held against the one stated."""
    if shown.reading is None or shown.is_mirrored or shown.solved[0].quarter_turned:
        return False
    if not shown.centre_is_free:
        return not shown.reading.alike
    # A principal point that is not stated, and that the stars leave open, turns the alignment.
    reach_rad, _ = shown.setup.star_search.reach_rad(shown.setup.prior.camera)
    return SIGMAS * max(shown.free.centre_sigma_px) < reach_rad * shown.focal_px


def _is_refused_for_stars(shown: Shown) -> bool:
    """True if a measurement finds too few stars, or none where they are predicted."""
    return shown.refused in ('no_match', 'no_stars', 'too_few_stars')


def _mirrored(shown: Shown) -> Finding | None:
    if not shown.is_mirrored:
        return None
    how, prior = 'left to right', prior_alignment(shown.setup)
    if shown.reading is not None and prior is not None:
        _, roll_rad = shown.reading.off_by(prior)
        if abs(roll_rad) > math.radians(135.0):
            how = 'top to bottom'
    return Finding(
        how,
        f'The image is mirrored {how}.',
        (f'# {NO_PARAMETER}mirror the images {how} where they are read out',),
        ('the patterns of the sky are there when the image is mirrored, not as it is',),
    )


def _no_attitudes(shown: Shown) -> Finding:
    return Finding(
        None,
        'There are no attitudes of the star tracker to hold against the images.',
        ('# record attitudes from before the first image to after the last',),
    )


def _frozen(shown: Shown) -> Finding | None:
    angle_rad = shown.case.turned_by_frozen_attitudes()
    if angle_rad is None:
        return None
    degrees = math.degrees(angle_rad)
    return Finding(
        round(degrees, 2),
        f'The attitudes stay the same while the stars turn by {degrees:.1f} degrees.',
        (f'# {NO_PARAMETER}record the attitudes that the star tracker measures',),
    )


def _no_reading(shown: Shown) -> Finding | None:
    """No cause can be named where no reading of the attitudes is the right one."""
    case = shown.case
    if case.turned_by_frozen_attitudes() is not None:
        return None
    several = [r for r in case.usual_readings() if r.agreeing == len(case.time_ns)]
    if len(several) > 1:
        return Finding(
            None,
            'The stars are identified, but attitudes that do not turn leave open how they are'
            ' meant, and prior_alignment goes with no way to read them.',
            ('# give a bag in which the spacecraft turns, or a prior_alignment to 1 degree',),
            (f'the images give one alignment read as {" and ".join(map(str, several))}',),
        )
    tested = 'two orders and two directions of the numbers'
    if len(case.time_ns) >= IMAGES_OF_A_READING:
        tested = (
            'every order, sign and direction of the numbers, any fixed inertial axes, the rotating'
            f' Earth, clocks up to {CLOCK_SEARCH_S:.0f} s or by time zones apart'
        )
    else:
        tested += f'; clocks and inertial axes need {IMAGES_OF_A_READING} images with attitudes'
    sentence = 'The stars of the images are identified, but the attitudes do not go with them'
    if turns := case.turns():
        by_stars, by_attitudes = (f'{math.degrees(angle):.1f}' for angle in turns)
        sentence += f': the stars turn by {by_stars} degrees, the attitudes by {by_attitudes}'
    else:
        sentence += ': there are none at the stamps of two images'
    return Finding(
        None,
        f'{sentence}.',
        ('# check that the attitudes belong to this spacecraft, star tracker and time',),
        (f'tested: {tested}; none gives one alignment for most of the images',),
    )


def _order(shown: Shown) -> Finding | None:
    numbers = shown.read.meaning.numbers
    if numbers == XYZW:
        return None
    mend = (f'# {NO_PARAMETER}send x, y, z, w in the fields of that name',)
    if numbers == W_FIRST:
        sentence = 'The attitude quaternions are sent with w first; the message has x, y, z, w.'
        return Finding('wxyz', sentence, mend)
    evidence = []
    reversed_axes = [name[1:] for name in numbers.split(', ') if name[0] == '-']
    if len(reversed_axes) == 2 and sorted(numbers.replace('-', '')) == sorted(XYZW):
        (axis,) = set('xyz') - set(reversed_axes)
        evidence.append(f'so are those of left-handed axes, with {axis} reversed')
    sentence = f'The fields x, y, z, w of the attitudes hold {numbers}.'
    return _or_alike(Finding(numbers, sentence, mend, tuple(evidence)), shown.read)


def _or_alike(finding: Finding, reading: Reading) -> Finding:
    """A finding with the other readings that explain the stars equally."""
    if not reading.alike:
        return finding
    listed = '; '.join(map(str, reading.alike))
    evidence = (*finding.evidence, f'the stars fit equally well read as: {listed}')
    sentence = f'{finding.sentence[:-1]}, or are {listed}.'
    return replace(finding, sentence=sentence, evidence=evidence)


def _direction(shown: Shown) -> Finding | None:
    given, meaning = shown.setup.attitude.attitude_direction, shown.read.meaning
    if meaning.direction == given:
        return None
    sentence = f'The attitude quaternions are {meaning}, not {given}.'
    return Finding(meaning.direction, sentence, (f'attitude_direction: {meaning.direction}',))


def _axes(shown: Shown) -> Finding | None:
    axes = shown.read.meaning.axes
    if not axes:
        return None
    sentence = f'The attitudes are in axes of {axes}, not of the ICRF.'
    mend = (f'# {NO_PARAMETER}send attitudes in axes of the ICRF (J2000)',)
    return _or_alike(Finding(axes, sentence, mend), shown.read)


def _clock(shown: Shown) -> Finding | None:
    shift_s = shown.shift_s + shown.read.shift_s
    if not shift_s:
        return None
    late_s, way = abs(shift_s), 'behind' if shift_s > 0 else 'ahead of'
    offset_s = round(shown.setup.attitude.stamp_offset_s + shift_s, 2)
    mend = [f'stamp_offset_s: {offset_s}']
    if late_s > _SAME_DATE_S:
        mend.append('# that takes the date of the attitudes: if it is wrong, correct their stamps')
    evidence = ['the attitude at the shifted stamps gives one alignment, at others not']
    evidence += [
        f'{late_s:.0f} s is {name}, of clocks in two time scales'
        for step_s, name in _CLOCKS.items()
        if abs(late_s - step_s) < _SAME_CLOCK_S
    ]
    zones_s = round(late_s / _ZONE_S) * _ZONE_S
    if 0 < zones_s < _SAME_DATE_S and abs(late_s - zones_s) < _SAME_CLOCK_S:
        evidence.append(f'{zones_s / 3600:g} h is the difference of two time zones')
    sentence = f'The stamps of the images are {late_s:.2f} s {way} those of the attitudes.'
    return Finding(offset_s, sentence, tuple(mend), tuple(evidence))


def _size(shown: Shown) -> Finding | None:
    """Images of another size than the prior camera: binned, a region, or of another mode."""
    if not shown.is_of_another_size:
        return None
    camera, prior = shown.free.camera, shown.setup.prior.camera
    evidence = [f'their focal length is that of the prior camera over {shown.bins}']
    mode = f'binned {shown.bins} x {shown.bins} (binning_x, binning_y of CameraInfo)'
    numbers = numbers_of_file(shown.stated)
    if shown.bins == 1:
        mode, numbers = 'a region of the detector (roi of CameraInfo)', centre_of_region(prior)
        place = ', '.join(f'{value:.0f}' for value in camera.parameters[3:5])
        sigma_px = max(shown.free.centre_sigma_px)
        evidence.append(f'the images show the principal point at ({place}) to {sigma_px:.0f} px')
    elif not shown.bins:
        mode, evidence = 'another mode', []
        numbers = f'fx = fy = {shown.focal_px:.1f}, and its principal point'
    return Finding(
        shown.bins or None,
        f'{sizes_in_words(camera, prior)}: {mode}.',
        (f'{size_of_file(camera)}{numbers}',),
        tuple(evidence),
    )


def _sides_exchanged(shown: Shown) -> Finding | None:
    if not shown.solved[0].quarter_turned:
        return None
    prior = prior_alignment(shown.setup)
    way, back = 'clockwise', 'counterclockwise'
    if prior is not None and shown.reading and shown.reading.quarter_turns(prior) == 2:
        way, back = back, way
    return Finding(
        90.0,
        f'The image is rotated by 90 degrees {way}.',
        (f'# {NO_PARAMETER}turn the images {back} where they are read out',),
        ('its sides are those of the prior camera exchanged',),
    )


def _rotated(shown: Shown) -> Finding | None:
    reading, prior = shown.alignment, prior_alignment(shown.setup)
    if reading is None or prior is None or not reading.is_off(prior, shown.setup):
        return None
    turns = reading.quarter_turns(prior)
    if not turns:
        return None
    degrees = 180.0 if turns == 2 else 90.0
    way = {1: ' counterclockwise', 2: '', 3: ' clockwise'}[turns]
    sentence = f'The image is rotated by {degrees:.0f} degrees{way} against prior_alignment.'
    return Finding(degrees, sentence, _aligned(reading), _away(reading, prior, shown.setup))


def _principal_point(shown: Shown) -> Finding | None:
    if not shown.centre_is_off:
        return None
    centre = [round(float(value), 1) for value in shown.free.camera.parameters[3:5]]
    stated = ', '.join(f'{value:.1f}' for value in shown.stated.parameters[3:5])
    off_px = float(np.hypot(*shown.centre_off_px))
    return Finding(
        centre,
        f'The principal point of the prior camera, ({stated}), is {off_px:.0f} px from where'
        f' the images show it, ({centre[0]}, {centre[1]}).',
        (f'{OF_FILE}cx = {centre[0]}, cy = {centre[1]}',),
        (
            f'the shape of the field shows it to {max(shown.free.centre_sigma_px):.1f} px',
            'a camera matrix of the whole detector with the size of a region looks so',
        ),
    )


def _focal_length(shown: Shown) -> Finding | None:
    focal_px, prior = shown.focal_px, shown.setup.prior.camera
    prior_px = float(prior.parameters[0])
    if shown.is_of_another_size or abs(focal_px / prior_px - 1.0) <= FOCAL_SHARE:
        return None
    sentence = (
        f'The focal length of the prior camera, {prior_px:.0f} px, is'
        f' {abs(100 * (prior_px / focal_px - 1)):.0f} % too'
        f' {"short" if focal_px > prior_px else "long"}'
    )
    found = round(focal_px, 2)
    if shown.stated is prior:
        return Finding(found, f'{sentence}.', (f'{OF_FILE}fx = fy = {focal_px:.1f}',))
    return Finding(
        found,
        f'{sentence}: its camera matrix is of pixels before {shown.bins} x {shown.bins} binning.',
        (f'{OF_FILE}{numbers_of_file(shown.stated)}',),
        ('focal length and principal point are those of binned pixels',),
    )


def _alignment(shown: Shown) -> Finding | None:
    reading, prior, setup = shown.alignment, prior_alignment(shown.setup), shown.setup
    assert reading is not None
    values = _values(reading)
    if prior is None:
        sentence = 'prior_alignment is not given; the images show it.'
        return Finding(values, sentence, _aligned(reading))
    if not reading.is_off(prior, setup) or reading.quarter_turns(prior):
        return None
    alignment = reading.star_tracker_from_camera
    w_first = Rotation.from_quat(prior.as_quat()[[1, 2, 3, 0]])
    identity_if = {
        'prior_alignment is the inverse of it: camera from star tracker': prior * alignment,
        'prior_alignment is given with w first': w_first.inv() * alignment,
        'the attitudes are those of the camera itself': alignment,
    }
    evidence = [
        text for text, turn in identity_if.items() if turn.magnitude() < _SAME_ALIGNMENT_RAD
    ]
    tilt_deg, roll_deg = (math.degrees(angle) for angle in reading.off_by(prior))
    tilt_px = math.radians(tilt_deg) * shown.focal_px
    most_px = min(
        SIGMAS * max(shown.free.centre_sigma_px), HALF_OF_IMAGE * shown.free.camera.width
    )
    if tilt_px < most_px:
        evidence.append(
            f'a principal point that is off by {tilt_px:.0f} px would look the same: check cx, cy'
        )
    stated = setup.identification.prior_alignment_sigma_deg
    return Finding(
        values,
        f'prior_alignment points {tilt_deg:.3g} degrees away from where the images show the'
        f' camera, and is rolled by {roll_deg:.3g} degrees; prior_alignment_sigma_deg:'
        f' {stated:g}.',
        _aligned(reading),
        (*_away(reading, prior, setup), *evidence),
    )


def _away(reading: Reading, prior: Rotation, setup: Setup) -> tuple[str, str]:
    """Evidence for a wrong prior alignment."""
    tilt_deg, roll_deg = (math.degrees(angle) for angle in reading.off_by(prior))
    stated = setup.identification.prior_alignment_sigma_deg
    away = f'points {tilt_deg:.3g} degrees away from it and is rolled by {roll_deg:.3g} degrees'
    return (
        f'prior_alignment {away}',
        f'images are searched to 3 sigma of prior_alignment_sigma_deg: {stated:g}',
    )


def _values(reading: Reading) -> list[float]:
    quaternion = reading.star_tracker_from_camera.as_quat(canonical=True)
    return [round(float(q), 7) for q in quaternion]


def _aligned(reading: Reading) -> tuple[str]:
    return (f'prior_alignment: {_values(reading)}',)


def _tone_curve(shown: Shown) -> Finding | None:
    slope, sigma = shown.brightness_slope() or (1.0, 0.0)
    least, most = _LINEAR_SLOPES
    power = f'measured brightness grows with catalog brightness to the power {slope:.2f}'
    evidence = (f'{power} ± {sigma:.2f}',)
    if slope + SIGMAS * sigma < least:
        return Finding(
            round(slope, 2),
            'The images are not linear in the light: they have been through a tone curve.',
            (f'# {NO_PARAMETER}record raw images',),
            evidence,
        )
    is_sharp = shown.star_shape is None or shown.star_shape.long_px < _SHARP_PX
    if slope - SIGMAS * sigma > most and is_sharp:
        return Finding(
            round(slope, 2),
            'The images were linear, and a tone curve that they never had was undone.',
            (f'# {NO_PARAMETER}give linear images as FITS, or with 16 bits',),
            evidence,
        )
    return None


def _one_shape(shown: Shown) -> Finding | None:
    shape = shown.star_shape
    return None if shape is None or shape.long_px < _NOT_SHARP_PX else not_sharp(shape)


def not_sharp(shape: StarShape) -> Finding:
    """The finding of stars that all have one shape, which is not that of sharp ones."""
    size = f'{shape.long_px:.1f} x {shape.wide_px:.1f} px (1-sigma)'
    sentence = (
        f'All stars are wide discs or rings alike, {size}: the lens is out of focus, or jitter'
        ' blurs them during the exposure.'
    )
    mend = 'focus the lens; if the stars stay as wide, expose for a shorter time'
    if math.isfinite(shape.along_deg):
        sentence = (
            f'All stars are elongated alike, {size}, at {shape.along_deg:.0f} degrees from +u'
            ' towards +v: by coma, or by a tracking error or jitter during the exposure.'
        )
        mend = 'expose for a shorter time; if the stars stay as long, align or focus the lens'
    evidence = f'median extents of {shape.stars} identified stars: {size}'
    return Finding(round(shape.long_px, 1), sentence, (f'# {NO_PARAMETER}{mend}',), (evidence,))


HYPOTHESES = (
    Hypothesis('mirrored', _always, _mirrored),
    Hypothesis('no_attitude', _lacks_attitudes, _no_attitudes),
    Hypothesis('frozen_attitude', _is_not_read, _frozen),
    Hypothesis('unknown', _is_not_read, _no_reading),
    Hypothesis('quaternion_order', _is_read, _order),
    Hypothesis('attitude_direction', _is_read, _direction),
    Hypothesis('axes', _is_read, _axes),
    Hypothesis('clock', _is_read, _clock),
    Hypothesis('wrong_size', _states_camera, _size),
    Hypothesis('rotated', _always, _sides_exchanged),
    Hypothesis('rotated', _is_aligned_by, _rotated),
    Hypothesis('principal_point', _states_camera, _principal_point),
    Hypothesis('focal_length', _states_camera, _focal_length),
    Hypothesis('prior_alignment', _is_aligned_by, _alignment),
    Hypothesis('not_linear', _always, _tone_curve),
    Hypothesis('one_shape', _is_refused_for_stars, _one_shape, alone=True),
)
"""Possible mistakes where images are identified, the one that hides the others first."""


def findings(shown: Shown) -> Sequence[tuple[str, Finding]]:
    """Causes and findings of the hypotheses that can be tested, in the order of the table."""
    found: list[tuple[str, Finding]] = []
    for hypothesis in HYPOTHESES:
        if hypothesis.needs(shown) and not (hypothesis.alone and found):
            finding = hypothesis.test(shown)
            found += [] if finding is None else [(hypothesis.cause, finding)]
    return found
