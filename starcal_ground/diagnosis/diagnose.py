# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Why the images of a set match no star: the set-up held against what the images show by themselves.

Some images are identified without attitude or alignment.  Each gives the true rotation of the
camera; with the attitude on the wire, read in one of the ways it can be meant, it gives the
alignment.  The right reading, of order, direction and clock, is the one whose alignment is the
same for all images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import functools
import math

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind.bright_sources import LONGEST_STREAK_PX, smear
from starcal_ground.blind.images import Identified, identify_images, Solved
from starcal_ros.arrays import Floats, Integers, Mask
from starcal_ros.camera import CameraModel
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Image
from starcal_ros.sky.attitude import AttitudeHistory, with_direction
from starcal_ros.sky.catalog import StarCatalog

CAUSES = (
    'none', 'mirrored', 'rotated', 'attitude_direction', 'quaternion_order', 'prior_alignment',
    'focal_length', 'clock', 'axes', 'smear', 'no_stars', 'not_linear', 'unknown',
)  # fmt: skip
IMAGES_OF_AN_ALIGNMENT = 3
_MOST_ATTITUDES = 20_000  # half an hour at 10 Hz: they are sent to another process
_FEW_SOURCES = 10  # in an image that nothing identifies: hot pixels are sources too

_NO_PARAMETER = 'no parameter mends this: '
_SAME_DATE_S = 86400.0  # aberration changes by 0.35 arcsec in a day
_FOCAL_SHARE = 0.03  # error of the focal length that an image is still matched with
_LINEAR_SLOPE = 0.5  # of brightness against that of the catalog; a display gamma of 2.2 has 0.45
_SAME_ALIGNMENT_RAD = math.radians(3.0)  # of one written in another way and the one found
_AGREE_RAD = math.radians(0.5)  # alignments of one reading that agree
_CLOCK_SEARCH_S = 61.0
_COARSE_STEP_S, _FINE_STEP_S = 0.25, 0.025
_CLEAR = 3.0  # least ratio of the scatters at which the better of two readings is accepted
_CLOCK_LEAST_RAD = math.radians(0.02)  # a clock error causes more scatter than this
_CLOCK_IMAGES = 3  # fewest: estimating the shift absorbs part of the information of two images
_ALIKE_RAD = math.radians(0.003)  # a smaller scatter is due to the stars
_WRONG_ALIGNMENT_RAD = math.radians(25.0)  # chance agreement is this close in one case of 200
_TURNED_RAD = math.radians(5.0)  # roll of a mounting that is right but for quarter turns
# Rotation matrices from the ICRF to other axes that attitudes may be in, at a Julian date (UTC).
_OTHER_AXES: Mapping[str, Callable[..., Floats]] = {
    'the mean equator and equinox of date': lambda *utc_jd: erfa.bp06(*utc_jd)[2],
    'the ecliptic of J2000': lambda *_: erfa.ecm06(erfa.DJ00, 0.0),
    'the rotating Earth': lambda *utc_jd: erfa.c2t06a(*utc_jd, *utc_jd, 0.0, 0.0),
}
_UNIX_EPOCH_JD = 2440587.5
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')
_ROLLS = [Rotation.from_euler('z', 90.0 * turns, degrees=True) for turns in range(4)]


@dataclass(frozen=True)
class WireAttitudes:
    """Attitudes as received: stamps (n,), ns, and four numbers (n, 4) in the order received."""

    time_ns: Integers
    quaternion: Floats


def wire_attitudes(history: AttitudeHistory, direction: str) -> WireAttitudes:
    """The last valid attitudes as received; ``direction`` is `attitude_direction`."""
    time_ns, xyzw = history.samples()
    last = slice(-_MOST_ATTITUDES, None)
    return WireAttitudes(time_ns[last], with_direction(xyzw[last], direction))


@dataclass(frozen=True)
class Reading:
    """One interpretation of the attitudes, and the mean alignment that follows."""

    order: str
    direction: str
    agreeing: int
    scatter_rad: float
    star_tracker_from_camera: Rotation
    shift_s: float = 0.0
    axes: str = ''  # of `_OTHER_AXES`; empty: ICRF

    def __str__(self) -> str:
        axes = f' in axes of {self.axes}' if self.axes else ''
        return f'{self.direction} ({", ".join(self.order)}){axes}'

    def off_by(self, prior: Rotation) -> tuple[float, float]:
        """Errors of a prior alignment against the one found, in pointing and in roll, rad."""
        axes = (prior.inv() * self.star_tracker_from_camera).as_matrix()
        tilt_rad = math.acos(min(max(float(axes[2, 2]), -1.0), 1.0))
        return tilt_rad, math.atan2(float(axes[1, 0]), float(axes[0, 0]))

    def is_off(self, prior: Rotation, setup: Setup) -> bool:
        """True if a prior alignment is off by more than images are searched to."""
        tilt_rad, roll_rad = self.off_by(prior)
        most_tilt_rad, most_roll_rad = setup.star_search.reach_rad(setup.prior.camera)
        return tilt_rad > most_tilt_rad or abs(roll_rad) > most_roll_rad

    def quarter_turns(self, prior: Rotation) -> int:
        """
        Number of quarter turns about the boresight that correct a prior alignment; 0 for none.

        Counted from the camera's +x towards its +y.
        """
        off = (self.off_by(prior * roll) for roll in _ROLLS)
        near = [max(3.0 * tilt_rad, abs(roll_rad)) < _TURNED_RAD for tilt_rad, roll_rad in off]
        return near.index(True) if any(near) else 0


def prior_alignment(setup: Setup) -> Rotation | None:
    """The prior ``star_tracker_from_camera``; None where it is not given."""
    if not setup.is_aligned:
        return None
    return Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)


def _ways(setup: Setup) -> list[tuple[str, str]]:
    """Orders and directions of the attitudes; the configured one is first."""
    given = setup.attitude.attitude_direction
    directions = sorted(_DIRECTIONS, key=lambda name: name != given)
    return [(order, direction) for order in ('xyzw', 'wxyz') for direction in directions]


@dataclass(frozen=True)
class Case:
    """Images of known rotation, the attitudes received near them, and the set-up."""

    solved: Sequence[Solved]
    attitudes: WireAttitudes
    setup: Setup

    def best_reading(self) -> Reading | None:
        """
        Reading that fits at least one image, the configured one if it does; None if none fits.

        If the images do not rotate, every reading fits and the prior alignment decides; the
        result is None if it supports no reading.
        """
        fit = self._fitting(self.readings())
        least_rad = min((reading.scatter_rad for reading in fit), default=math.inf)
        if len(self.solved) >= _CLOCK_IMAGES and least_rad > _CLOCK_LEAST_RAD:
            most = max((reading.agreeing for reading in fit), default=0)
            for other in self._others():
                if not fit or (other.agreeing >= most and other.scatter_rad * _CLEAR < least_rad):
                    return other
        return self._likeliest(fit)

    def readings(self) -> list[Reading]:
        """Every reading with its alignments; the configured one is first."""
        return [self._at_shifts(way, np.zeros(1))[0] for way in _ways(self.setup)]

    def _fitting(self, readings: Sequence[Reading]) -> list[Reading]:
        """Readings supported by most images, and by about as many as the best reading."""
        images = len(self.solved)
        enough = images if images < 3 else max(3, math.ceil(0.6 * images))
        if self.setup.is_aligned and images == 3:
            enough = 2  # one of the attitudes may be wrong
        fit = [reading for reading in readings if reading.agreeing >= enough]
        most = max((reading.agreeing for reading in fit), default=0)
        fit = [reading for reading in fit if reading.agreeing >= 0.8 * most]
        least_rad = min((max(r.scatter_rad, _ALIKE_RAD) for r in fit), default=0.0)
        return [reading for reading in fit if reading.scatter_rad < _CLEAR * least_rad]

    def _likeliest(self, fit: Sequence[Reading]) -> Reading | None:
        """Reading that the prior alignment supports among readings that fit equally well."""
        if len(fit) < 2:
            return next(iter(fit), None)
        prior = prior_alignment(self.setup)
        if prior is None:
            is_given = (fit[0].order, fit[0].direction) == _ways(self.setup)[0]
            return fit[0] if is_given else None
        near = [reading for reading in fit if not reading.is_off(prior, self.setup)]
        if near:
            return near[0]
        likely = [
            reading
            for reading in fit
            if reading.quarter_turns(prior)
            or (prior.inv() * reading.star_tracker_from_camera).magnitude() < _WRONG_ALIGNMENT_RAD
        ]
        return likely[0] if len(likely) == 1 else None

    def _at_shifts(self, way: tuple[str, str], shift_s: Floats, axes: str = '') -> list[Reading]:
        """The reading of each shift (s,) of the stamps, with the most alignments that agree."""
        images = len(self.solved)
        stamps_ns = np.array([image.time_ns for image in self.solved])
        at_ns = stamps_ns + np.rint(shift_s[:, None] * NANOSECONDS_PER_SECOND).astype(np.int64)
        read, usable = _read_at(self.attitudes, at_ns.ravel(), way, self.setup)
        quaternion = np.zeros((len(usable), 4))  # of no rotation: it agrees with none
        if read is not None:
            read = _to_icrf(axes, at_ns.ravel()[usable]) * read if axes else read
            icrf_from_camera = Rotation.concatenate(
                [image.sky.camera_from_icrf for image in self.solved]
            ).inv()
            image = np.flatnonzero(usable) % images
            quaternion[usable] = (read.inv() * icrf_from_camera[image]).as_quat()
        agreeing, scatter_rad, mean = _agreed(quaternion.reshape(-1, images, 4))
        return [
            Reading(
                *way, int(agreeing[k]), float(scatter_rad[k]), mean[k], float(shift_s[k]), axes
            )
            for k in range(len(shift_s))
        ]

    def _others(self) -> Iterator[Reading]:
        """Readings that most images support in other axes, then with a shift of the stamps."""
        ways, none = _ways(self.setup), np.zeros(1)
        turned = [self._at_shifts(way, none, axes)[0] for axes in _OTHER_AXES for way in ways]
        yield from self._fitting(turned)[:1]
        steps = round(_CLOCK_SEARCH_S / _COARSE_STEP_S)
        coarse: Floats = _COARSE_STEP_S * np.arange(-steps, steps + 1, dtype=np.float64)
        fine: Floats = _FINE_STEP_S * np.arange(-12, 13, dtype=np.float64)
        readings = []
        for way in ways:
            tried = self._at_shifts(way, coarse)
            tried += self._at_shifts(way, min(tried, key=_rank).shift_s + fine)
            readings.append(_middle_of_best(tried))
        yield from self._fitting(readings)[:1]


def expected_rotations(attitudes: WireAttitudes, setup: Setup, time_ns: int) -> list[Rotation]:
    """
    Rotations ``camera_from_icrf`` of an image by each reading; the configured one is first.

    They include cameras rolled by quarter turns.  Empty without a prior alignment.
    """
    prior = prior_alignment(setup)
    if prior is None:
        return []
    sent = (_read_at(attitudes, np.array([time_ns]), way, setup)[0] for way in _ways(setup))
    read = [(rotations[0] * prior).inv() for rotations in sent if rotations is not None]
    return [_ROLLS[turns] * rotation for turns in (0, 2, 1, 3) for rotation in read]


def _agreed(quaternion: Floats) -> tuple[Integers, Floats, Rotation]:
    """
    Counts (s,), scatters (s,) and means of the largest groups of alignments that agree.

    ``quaternion`` (s, m, 4) of m alignments, zero where there is none; the scatter of none is pi.
    """
    cosine = np.abs(quaternion @ quaternion.transpose(0, 2, 1))
    near = 2 * np.arccos(np.minimum(cosine, 1.0)) < _AGREE_RAD
    middle = near.sum(axis=2).argmax(axis=1)
    group = near[np.arange(len(near)), middle]
    count = group.sum(axis=1)
    members = quaternion * group[:, :, None]
    _, vectors = np.linalg.eigh(members.transpose(0, 2, 1) @ members)
    mean = vectors[:, :, -1]
    # Half of the angle from the mean: its cosine would lose half of the digits.
    along = np.einsum('smi,si->sm', members, mean)
    across = np.linalg.norm(members - along[:, :, None] * mean[:, None], axis=2)
    off = 2.0 * np.arctan2(across, np.abs(along))
    squared = (off**2).sum(axis=1) / np.maximum(count, 1)
    return count, np.where(count > 0, np.sqrt(squared), math.pi), Rotation.from_quat(mean)


def _read_at(
    attitudes: WireAttitudes, at_ns: Integers, way: tuple[str, str], setup: Setup
) -> tuple[Rotation | None, Mask]:
    """
    Rotations ``icrf_from_star_tracker`` at the selected stamps of (n,).

    Stamps without two samples near enough are omitted; None if no stamp remains.
    """
    order, direction = way
    times = attitudes.time_ns
    if len(times) < 2:
        return None, np.zeros(len(at_ns), bool)
    after = np.clip(np.searchsorted(times, at_ns, side='left'), 1, len(times) - 1)
    gap_ns = times[after] - times[after - 1]
    usable = (at_ns >= times[after - 1]) & (at_ns <= times[after])
    usable &= gap_ns <= setup.attitude.max_attitude_gap_s * NANOSECONDS_PER_SECOND
    if not usable.any():
        return None, usable
    ends = after[usable]
    q = attitudes.quaternion[:, [1, 2, 3, 0]] if order == 'wxyz' else attitudes.quaternion
    before, behind = Rotation.from_quat(q[ends - 1]), Rotation.from_quat(q[ends])
    part = (at_ns[usable] - times[ends - 1]) / np.maximum(gap_ns[usable], 1)
    sent = before * Rotation.from_rotvec(part[:, None] * (before.inv() * behind).as_rotvec())
    return (sent.inv() if direction == 'inertial_to_st' else sent), usable


def _to_icrf(axes: str, at_ns: Integers) -> Rotation:
    day_ns = 86400 * NANOSECONDS_PER_SECOND
    from_icrf = [_OTHER_AXES[axes](_UNIX_EPOCH_JD, float(ns) / day_ns) for ns in at_ns]
    return Rotation.from_matrix(np.array(from_icrf)).inv()


def _rank(reading: Reading) -> tuple[int, float]:
    return -reading.agreeing, reading.scatter_rad


def _middle_of_best(tried: Sequence[Reading]) -> Reading:
    """The best shift; the middle of equally good ones, which a camera at rest has."""
    best = min(tried, key=_rank)
    limit_rad = max(1.2 * best.scatter_rad, _ALIKE_RAD)
    by_shift = sorted(tried, key=lambda r: r.shift_s)
    good = [r.agreeing == best.agreeing and r.scatter_rad <= limit_rad for r in by_shift]
    first = last = by_shift.index(best)
    while first > 0 and good[first - 1]:
        first -= 1
    while last + 1 < len(good) and good[last + 1]:
        last += 1
    middle_s = 0.5 * (by_shift[first].shift_s + by_shift[last].shift_s)
    nearest = min(by_shift[first : last + 1], key=lambda r: abs(r.shift_s - middle_s))
    return replace(nearest, shift_s=middle_s)


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

    def in_a_sentence(self, command: str = 'starcal diagnose') -> str:
        """Cause and remedy, as the end of a complaint; ``command`` gives the evidence, if any."""
        said = [self.sentence]
        if options := '; '.join(line for line in self.mend if not line.startswith('#')):
            said.append(f'Set {options}.')
        for line in self.mend:
            if line.startswith('#'):
                advice = line.removeprefix('# ').removeprefix(_NO_PARAMETER)
                said.append(f'{advice[0].upper()}{advice[1:]}.')
        return ' '.join([*said, f'(details: {command})'] if command else said)


def found_alignment(diagnosis: Diagnosis) -> tuple[list[float] | None, str]:
    """The alignment of a diagnosis without a prior one, or None, with a sentence on it."""
    if diagnosis.cause != 'prior_alignment' or not isinstance(diagnosis.found, list):
        return None, diagnosis.in_a_sentence()
    if diagnosis.images < IMAGES_OF_AN_ALIGNMENT:
        return None, (f'{diagnosis.images} images agree, {IMAGES_OF_AN_ALIGNMENT} are needed.')
    return diagnosis.found, (
        f'prior_alignment is not given: found {diagnosis.found} from {diagnosis.images} images'
        ' that agree.'
    )


@one_blas_thread()
def diagnose(
    images: Iterable[Image], attitudes: WireAttitudes, setup: Setup, shift_s: float = 0.0
) -> Diagnosis:
    """
    The cause that keeps the first images from matching, found from those images.

    ``shift_s`` was added to the stamps of the images, whose clock is far from that of the
    attitudes.
    """
    guesses = functools.partial(expected_rotations, attitudes, setup)
    identified = identify_images(images, setup.prior.camera, setup.catalog, guesses)
    if identified.solved:
        return _held_against(
            Case(identified.solved, attitudes, setup), len(identified.sources), shift_s
        )
    return _nothing_found(identified, setup)


def _nothing_found(identified: Identified, setup: Setup) -> Diagnosis:
    """The cause where no image was identified."""
    camera, looked_at = setup.prior.camera, identified.sources
    if not looked_at and identified.other_sizes:
        return _of_another_size(*identified.other_sizes[0], camera)
    if not looked_at:
        return Diagnosis('no_stars', 0, 'There is no image that can be read.')
    count = int(np.median([len(sources.xy_px) for sources in looked_at]))
    streaks = [streak for streak in map(smear, looked_at) if streak is not None]
    looked = f'{len(looked_at)} images looked at, {count} star-like sources each'
    if 2 * len(streaks) > len(looked_at):
        return _smeared(float(np.median([length for length, _ in streaks])), looked)
    if count < _FEW_SOURCES:
        level = float(np.median([s.background.level_dn for s in looked_at]))
        noise = float(np.median([s.background.noise_dn for s in looked_at]))
        return Diagnosis(
            'no_stars',
            count,
            f'The images show too few stars: {count} sources each, and five have to be stars.',
            (looked, f'background {level:.0f} DN with a noise of {noise:.1f} DN'),
            ('# no parameter mends this: expose for longer, or check that the lens sees the sky',),
        )
    focal_px = float(camera.parameters[0])
    width_deg = math.degrees(2 * math.atan(camera.width / 2 / focal_px))
    return Diagnosis(
        'unknown',
        None,
        'No image can be identified, for a cause that is not known.',
        (
            looked,
            'no pattern of them was found in the sky, mirrored or not, in the time of the search',
            f'tried: focal lengths of 0.25 to 4 times {focal_px:.0f} px, {width_deg:.1f} deg wide',
        ),
        ('# check camera_info_url: focal length in pixels, size of the image',),
    )


def _of_another_size(width: int, height: int, camera: CameraModel) -> Diagnosis:
    """The cause where images are not of the size of the prior camera: binned, cut, or another."""
    sizes = f'{width} x {height}, the prior camera is of {camera.width} x {camera.height}'
    fields = 'binning_x, binning_y of CameraInfo'
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics)
    bins = camera.width // width
    of_file = f'# in the file of camera_info_url: image_width: {width}, image_height: {height}'
    if bins > 1 and (camera.width // bins, camera.height // bins) == (width, height):
        # The centre of the first pixel is (0, 0), and of a bin the mean of its pixels.
        binned = (fx / bins, fy / bins, *((c + 0.5) / bins - 0.5 for c in (cx, cy)))
        numbers = ', '.join(f'{value:.2f}' for value in binned)
        return Diagnosis(
            'unknown',
            bins,
            f'The images are {sizes}: binned {bins} x {bins} ({fields}).',
            mend=(f'{of_file}, and fx, fy, cx, cy = {numbers}',),
        )
    if width <= camera.width and height <= camera.height:
        sentence = f'The images are {sizes}: a part of the detector (roi of CameraInfo).'
        centre = f'cx = {cx:.2f} - x_offset, cy = {cy:.2f} - y_offset of the region'
        return Diagnosis('unknown', None, sentence, mend=(f'{of_file}, {centre}',))
    evidence = 'images of another size are of another camera or mode'
    mend = f'{of_file}, and the focal length in their pixels'
    return Diagnosis('unknown', None, f'The images are {sizes}.', (evidence,), (mend,))


def _smeared(length_px: float, looked: str) -> Diagnosis:
    """The cause where most images show streaks of this length."""
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


def _held_against(case: Case, tried: int, shift_s: float) -> Diagnosis:
    """The causes where images were identified, the one that hides the others first."""
    solved, setup = case.solved, case.setup
    worst = max(image.sky.log10_p_value for image in solved)
    stars = [len(image.sky.xy_px) for image in solved]
    focal_px = float(np.median([image.sky.camera.parameters[0] for image in solved]))
    prior_px = float(setup.prior.camera.parameters[0])
    identified = f'{len(solved)} of {tried} images identified without attitude'
    # A smaller bound is no better evidence.
    chance = f'expected false matches: under 10^{max(worst, -12.0):.0f} each'
    evidence = [f'{identified}, {min(stars)} to {max(stars)} stars each; {chance}']
    reading = case.best_reading()
    is_mirrored = solved[0].sky.mirrored
    findings = [_mirrored(reading, setup)] if is_mirrored else []
    if reading is not None:
        evidence += _agreement(reading, case)
        findings += [*_order(reading), *_direction(reading, setup), *_axes(reading)]
        findings += _clock(shift_s + reading.shift_s, setup)
        if solved[0].quarter_turned:
            findings.append(_sides_exchanged(reading, setup))
        elif not is_mirrored:
            findings += _alignment(reading, setup)
    elif not is_mirrored:
        findings.append(_no_reading(case))
    evidence.append(
        f'the images show a focal length of {focal_px:.1f} px, the prior {prior_px:.1f}'
    )
    findings += [*_focal_length(focal_px, prior_px), *_tone_curve(solved, setup.catalog)]
    joined = _joined(findings, evidence)
    return replace(joined, images=0 if reading is None else reading.agreeing)


def _joined(findings: Sequence[Diagnosis], evidence: list[str]) -> Diagnosis:
    """The first of the findings, with the remedies of all of them."""
    if not findings:
        sentence = 'Attitudes, alignment and camera fit the images.'
        return Diagnosis('none', None, sentence, tuple(evidence))
    first, *others = findings
    for finding in findings:
        evidence += finding.evidence
    evidence += [f'besides: {finding.sentence}' for finding in others]
    return replace(
        first,
        evidence=tuple(evidence),
        mend=tuple(line for finding in findings for line in finding.mend),
        also=tuple(finding.cause for finding in others),
    )


def _agreement(reading: Reading, case: Case) -> list[str]:
    """Evidence for a reading, and against the one set up where that is another."""
    alike = f'give one alignment to {math.degrees(reading.scatter_rad):.3f} degrees'
    of = f'{reading.agreeing} of {len(case.solved)} images'
    lines = [f'read as {reading}, the attitudes of {of} {alike}']
    given = case.readings()[0]
    if str(reading) != str(given):
        agree = f'those of {given.agreeing} agree to {math.degrees(given.scatter_rad):.3f} degrees'
        if given.agreeing < 2:
            agree = 'no two agree'
        lines.append(f'read as {given}, as they are now, {agree}')
    return lines


# Each of the following is one cause; a list is empty where there is nothing wrong.


def _order(reading: Reading) -> list[Diagnosis]:
    if reading.order == 'xyzw':
        return []
    sentence = 'The attitude quaternions are sent with w first; the message has x, y, z, w.'
    mend = '# no parameter mends this: send x, y, z, w in the fields of that name'
    return [Diagnosis('quaternion_order', 'wxyz', sentence, mend=(mend,))]


def _direction(reading: Reading, setup: Setup) -> list[Diagnosis]:
    given, shown = setup.attitude.attitude_direction, reading.direction
    if shown == given:
        return []
    sentence = f'The attitude quaternions are {reading}, not {given}.'
    mend = f'attitude_direction: {shown}'
    return [Diagnosis('attitude_direction', shown, sentence, mend=(mend,))]


def _axes(reading: Reading) -> list[Diagnosis]:
    if not reading.axes:
        return []
    sentence = f'The attitudes are in axes of {reading.axes}, not of the ICRF.'
    mend = f'# {_NO_PARAMETER}send attitudes in axes of the ICRF (J2000)'
    return [Diagnosis('axes', reading.axes, sentence, mend=(mend,))]


def _clock(shift_s: float, setup: Setup) -> list[Diagnosis]:
    if not shift_s:
        return []
    offset_s = round(setup.attitude.stamp_offset_s + shift_s, 2)
    mend = [f'stamp_offset_s: {offset_s}']
    if abs(shift_s) > _SAME_DATE_S:
        mend.append('# that takes the date of the attitudes: if it is wrong, correct their stamps')
    sentence = (
        f'The stamps of the images are {abs(shift_s):.2f} s'
        f' {"behind" if shift_s > 0 else "ahead of"} those of the attitudes.'
    )
    evidence = 'the attitude at the shifted stamps gives one alignment, at others not'
    return [Diagnosis('clock', offset_s, sentence, (evidence,), tuple(mend))]


def _alignment(reading: Reading, setup: Setup) -> list[Diagnosis]:
    alignment, prior = reading.star_tracker_from_camera, prior_alignment(setup)
    values = [round(float(q), 7) for q in alignment.as_quat(canonical=True)]
    mend = (f'prior_alignment: {values}',)
    if prior is None:
        sentence = 'prior_alignment is not given; the images show it.'
        return [Diagnosis('prior_alignment', values, sentence, (), mend)]
    if not reading.is_off(prior, setup):
        return []
    tilt_deg, roll_deg = (math.degrees(angle) for angle in reading.off_by(prior))
    away = f'{tilt_deg:.3g} degrees away from it and is rolled by {roll_deg:.3g} degrees'
    stated = setup.identification.prior_alignment_sigma_deg
    evidence = [
        f'prior_alignment points {away}',
        f'images are searched to 3 sigma of prior_alignment_sigma_deg: {stated:g}',
    ]
    if turns := reading.quarter_turns(prior):
        degrees = 180.0 if turns == 2 else 90.0
        way = {1: ' counterclockwise', 2: '', 3: ' clockwise'}[turns]
        sentence = f'The image is rotated by {degrees:.0f} degrees{way} against prior_alignment.'
        return [Diagnosis('rotated', degrees, sentence, tuple(evidence), mend)]
    if (prior * alignment).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is the inverse of it: camera from star tracker')
    w_first = type(prior).from_quat(prior.as_quat()[[1, 2, 3, 0]])
    if (w_first.inv() * alignment).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is given with w first')
    sentence = (
        f'prior_alignment points {tilt_deg:.3g} degrees away from where the images show the'
        f' camera, and is rolled by {roll_deg:.3g} degrees; prior_alignment_sigma_deg: {stated:g}.'
    )
    return [Diagnosis('prior_alignment', values, sentence, tuple(evidence), mend)]


def _sides_exchanged(reading: Reading, setup: Setup) -> Diagnosis:
    prior = prior_alignment(setup)
    way, back = 'clockwise', 'counterclockwise'
    if prior is not None and reading.quarter_turns(prior) == 2:
        way, back = back, way
    return Diagnosis(
        'rotated',
        90.0,
        f'The image is rotated by 90 degrees {way}.',
        ('its sides are those of the prior camera exchanged',),
        (f'# no parameter mends this: turn the images {back} where they are read out',),
    )


def _mirrored(reading: Reading | None, setup: Setup) -> Diagnosis:
    how, prior = 'left to right', prior_alignment(setup)
    if reading is not None and prior is not None:
        _, roll_rad = reading.off_by(prior)
        if abs(roll_rad) > math.radians(135.0):
            how = 'top to bottom'
    return Diagnosis(
        'mirrored',
        how,
        f'The image is mirrored {how}.',
        ('the patterns of the sky are there when the image is mirrored, not as it is',),
        (f'# no parameter mends this: mirror the images {how} where they are read out',),
    )


def _no_reading(case: Case) -> Diagnosis:
    """No cause can be named where no reading of the attitudes is the right one."""
    several = [r for r in case.readings() if r.agreeing == len(case.solved)]
    if len(several) > 1:
        return Diagnosis(
            'unknown',
            None,
            'The stars are identified, but attitudes that do not turn leave open how they are'
            ' meant, and prior_alignment goes with no way to read them.',
            (f'the images give one alignment read as {" and ".join(map(str, several))}',),
            ('# give a bag in which the spacecraft turns, or a prior_alignment to 1 degree',),
        )
    tried = (
        f'no reading of the {len(case.attitudes.time_ns)} attitudes, at shifts of up to'
        f' {_CLOCK_SEARCH_S:.0f} s, gives one alignment for most of the images'
    )
    return Diagnosis(
        'unknown',
        None,
        'The stars of the images are identified, but the attitudes do not go with them.',
        (tried,),
        ('# check that the attitudes belong to this spacecraft, star tracker and time',),
    )


def _focal_length(focal_px: float, prior_px: float) -> list[Diagnosis]:
    if abs(focal_px / prior_px - 1.0) <= _FOCAL_SHARE:
        return []
    sentence = (
        f'The focal length of the prior camera, {prior_px:.0f} px, is'
        f' {abs(100 * (prior_px / focal_px - 1)):.0f} % too'
        f' {"short" if focal_px > prior_px else "long"}.'
    )
    mend = f'# in the file of camera_info_url: fx = fy = {focal_px:.1f}'
    return [Diagnosis('focal_length', round(focal_px, 2), sentence, mend=(mend,))]


def _tone_curve(solved: Sequence[Solved], catalog: StarCatalog) -> list[Diagnosis]:
    slope = _brightness_slope(max(solved, key=lambda image: len(image.sky.xy_px)), catalog)
    if slope is None or slope >= _LINEAR_SLOPE:
        return []
    sentence = 'The images are not linear in the light: they have been through a tone curve.'
    evidence = f'measured brightness grows with catalog brightness to the power {slope:.2f}'
    mend = '# no parameter mends this: record raw images'
    return [Diagnosis('not_linear', round(slope, 2), sentence, (evidence,), (mend,))]


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
