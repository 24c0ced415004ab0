# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Why the images of a set match no star: the set-up held against what the images show by themselves.

Some images are identified without attitude or alignment.  Each gives the true rotation of the
camera, and all together one camera.  `HYPOTHESES` is the table of what can be wrong, each with
what it needs: nothing is named that was not tested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind.bright_sources import LONGEST_STREAK_PX, smear
from starcal_ground.blind.common_camera import common_camera, CommonCamera
from starcal_ground.blind.images import Identified, identify_images, LOOKED_AT, Solved
from starcal_ground.diagnosis.attitude_readings import (
    Case,
    CLOCK_SEARCH_S,
    expected_rotations,
    IMAGES_OF_A_READING,
    prior_alignment,
    Reading,
    W_FIRST,
    WireAttitudes,
    XYZW,
)
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Image
from starcal_ros.robust_statistics import MAD_TO_SIGMA

IMAGES_OF_AN_ALIGNMENT = 3
_FEW_SOURCES = 10  # in an image that nothing identifies: hot pixels are sources too

_NO_PARAMETER = 'no parameter mends this: '
_OF_FILE = '# in the file of camera_info_url: '
_SAME_DATE_S = 86400.0  # aberration changes by 0.35 arcsec in a day
_FOCAL_SHARE = 0.03  # error of the focal length that an image is still matched with
# Power of the light of the catalog that pixel values follow: 0.45 after a display gamma of 2.2,
# 2.2 where one was undone that was not there.
# Linear cameras of seven kinds follow 0.73 to 1.23.
_LINEAR_SLOPES = 0.5, 1.6
_FEW_IN_AN_IMAGE = 5  # stars whose brightnesses are compared with each other
_FAR_DEX = 0.2  # least difference of two stars: half a magnitude, twice their usual scatter
_SAME_ALIGNMENT_RAD = math.radians(3.0)  # notations of one alignment differ by less
_MOST_BINNED = 8
_SIGMAS = 3.0  # significance with which the stars show the principal point elsewhere
_HELD = 1e-5  # range, widths, of a principal point that is held
_FREE = 0.5  # range of one that is free: the whole image
# Differences of clocks that people mix up, s, with an error of a shift.
_CLOCKS = {37.0: 'TAI - UTC', 18.0: 'GPS time - UTC', 69.184: 'TT - UTC', 32.184: 'TT - TAI'}
_SAME_CLOCK_S, _ZONE_S = 0.2, 900.0


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


@dataclass(frozen=True)
class Shown:
    """
    Camera and rotations that identified images show, and the set-up to hold against them.

    ``bins`` are the pixels of the prior camera along one of the images, 0 for another focal
    length; ``stated`` is the prior camera in the pixels of the images, as far as it states them.
    ``free`` is the camera of all images, ``held`` the same with the principal point stated.
    ``refused`` is the most frequent reason for which a measurement with the set-up refuses images;
    empty: none.
    """

    solved: Sequence[Solved]
    tried: int
    case: Case
    setup: Setup
    bins: int
    stated: CameraModel
    free: CommonCamera
    held: CommonCamera
    shift_s: float
    refused: str = ''

    @functools.cached_property
    def reading(self) -> Reading | None:
        """The reading of the attitudes, its alignment that of the principal point stated."""
        reading = self.case.best_reading() if self.has_attitudes else None
        if reading is None or self.centre_is_free:
            return reading
        return reading.with_camera(self._free_from_held)

    @functools.cached_property
    def _free_from_held(self) -> Rotation:
        # A shift of the principal point is a rotation of all cameras alike.
        return (self.free.camera_from_icrf * self.held.camera_from_icrf.inv()).mean()

    def _for_free(self, reading: Reading) -> Reading:
        return reading.with_camera(self._free_from_held.inv())

    @property
    def has_attitudes(self) -> bool:
        """True if there are attitudes of a star tracker, which somebody has given."""
        return self.setup.has_tracker and len(self.case.attitudes.time_ns) > 1

    @property
    def is_mirrored(self) -> bool:
        """True if the images are mirror images."""
        return self.solved[0].sky.mirrored

    @property
    def is_of_another_size(self) -> bool:
        """True if the images are not of the size of the prior camera."""
        camera, prior = self.free.camera, self.setup.prior.camera
        return (camera.width, camera.height) != (prior.width, prior.height)

    @property
    def centre_is_free(self) -> bool:
        """True if the principal point is not stated: that of a region of the detector."""
        return self.is_of_another_size and self.bins <= 1

    @property
    def focal_px(self) -> float:
        """Focal length of the images."""
        return float(self.free.camera.parameters[0])

    @functools.cached_property
    def centre_off_px(self) -> Floats:
        """Principal point (2,) of the images less the one stated."""
        return np.asarray(self.free.camera.parameters[3:5] - self.stated.parameters[3:5])

    @functools.cached_property
    def centre_is_off(self) -> bool:
        """
        True if the stars show a principal point that explains why no image matches.

        It has to explain it alone, or to be off by three times the 1-sigma that a calibration
        assumes, which can take up less.
        """
        if self.centre_is_free or self.solved[0].quarter_turned:
            return False
        camera = self.free.camera
        off_px, longer = np.abs(self.centre_off_px), max(camera.width, camera.height)
        is_shown = bool((off_px > _SIGMAS * np.array(self.free.centre_sigma_px)).any())
        sigmas = float(np.hypot(*off_px)) / longer / self.setup.calibration.principal_point_prior
        if not is_shown or sigmas < 1.0:
            return False
        prior, reading = prior_alignment(self.setup), self.reading
        if reading is None or prior is None:
            return self.refused == 'no_match' and sigmas > _SIGMAS
        if self.refused != 'no_match' and not reading.is_off(prior, self.setup):
            return False
        return sigmas > _SIGMAS or not self._for_free(reading).is_off(prior, self.setup)

    @functools.cached_property
    def alignment(self) -> Reading | None:
        """The reading with the alignment that goes with the principal point to use."""
        if not (self.reading and self.centre_is_off):
            return self.reading
        return self._for_free(self.reading)


@one_blas_thread()
def diagnose(
    images: Iterable[Image],
    attitudes: WireAttitudes,
    setup: Setup,
    shift_s: float = 0.0,
    refused: str = '',
) -> Diagnosis:
    """
    The cause that keeps the first images from matching, found from those images.

    ``shift_s`` was added to the stamps of the images, whose clock is far from that of the
    attitudes.  ``refused`` is the most frequent reason for which a measurement with the set-up
    refuses images; empty: none.
    """
    looked = list(itertools.islice(images, LOOKED_AT))
    camera = _camera_of_size(looked, setup.prior.camera)
    guesses = functools.partial(expected_rotations, attitudes, setup)
    if not setup.has_tracker:
        attitudes = replace(attitudes, time_ns=attitudes.time_ns[:0])
    identified = identify_images(looked, camera, setup.catalog, guesses)
    if not identified.solved:
        return _nothing_found(identified, camera, setup)
    shown = _shown(identified, camera, attitudes, setup, shift_s)
    return _held_against(replace(shown, refused=refused))


def _camera_of_size(images: Sequence[Image], prior: CameraModel) -> CameraModel:
    """The prior camera, or one for images of which none has its size, binned where they can be."""
    sizes = {image.pixels.shape for image in images}
    own = {(prior.height, prior.width), (prior.width, prior.height)}
    if not sizes or sizes & own:
        return prior
    height, width = max(sizes)
    bins = max(prior.width // width, 1)
    if (prior.width // bins, prior.height // bins) == (width, height):
        return _binned(prior, bins)
    middle = (width - 1) / 2, (height - 1) / 2
    return replace(prior, width=width, height=height).replace(cx=middle[0], cy=middle[1])


def _binned(camera: CameraModel, bins: int) -> CameraModel:
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


def _shown(
    identified: Identified,
    camera: CameraModel,
    attitudes: WireAttitudes,
    setup: Setup,
    shift_s: float,
) -> Shown:
    solved, prior = identified.solved, setup.prior.camera
    skies = [image.sky for image in solved]
    free = common_camera(skies, camera, setup.catalog, _FREE)
    ratio = float(prior.parameters[0]) / float(free.camera.parameters[0])
    bins = min(max(round(ratio), 1), _MOST_BINNED)
    bins = bins if abs(ratio / bins - 1.0) <= _FOCAL_SHARE else 0
    # A camera matrix may be of the pixels of the images, or of unbinned ones.
    matrices = [prior] if prior.width == camera.width and prior.height == camera.height else []
    whole = _binned(prior, max(bins, 1))
    if bins > 1 or (whole.width, whole.height) == (camera.width, camera.height):
        matrices.append(replace(whole, width=camera.width, height=camera.height))
    centre_px = free.camera.parameters[3:5]
    stated = min(
        matrices or [free.camera],
        key=lambda matrix: float(np.hypot(*(matrix.parameters[3:5] - centre_px))),
    )
    held = common_camera(skies, stated, setup.catalog, _HELD)
    time_ns = np.array([image.time_ns for image in solved])
    case = Case(time_ns, free.camera_from_icrf.inv(), attitudes, setup)
    tried = len(identified.sources)
    return Shown(solved, tried, case, setup, bins, stated, free, held, shift_s)


def _nothing_found(identified: Identified, searched: CameraModel, setup: Setup) -> Diagnosis:
    """The cause where no image was identified."""
    camera, looked_at = setup.prior.camera, identified.sources
    if not looked_at:
        return Diagnosis('no_stars', 0, 'There is no image that can be read.')
    count = int(np.median([len(sources.xy_px) for sources in looked_at]))
    streaks = [streak for streak in map(smear, looked_at) if streak is not None]
    looked = f'{len(looked_at)} images looked at, {count} star-like sources each'
    if 2 * len(streaks) > len(looked_at):
        return _smeared(float(np.median([length for length, _ in streaks])), looked)
    if (searched.width, searched.height) != (camera.width, camera.height):
        return _of_another_size(searched.width, searched.height, camera, looked)
    if count < _FEW_SOURCES:
        level = float(np.median([s.background.level_dn for s in looked_at]))
        noise = float(np.median([s.background.noise_dn for s in looked_at]))
        return Diagnosis(
            'no_stars',
            count,
            f'The images show too few stars: {count} sources each, and five have to be stars.',
            (looked, f'background {level:.0f} DN with a noise of {noise:.1f} DN'),
            (f'# {_NO_PARAMETER}expose for longer, or check that the lens sees the sky',),
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


def _of_another_size(width: int, height: int, camera: CameraModel, looked: str) -> Diagnosis:
    """The cause where images of another size than the prior camera's show no known stars."""
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics)
    mend = []
    bins = max(camera.width // width, 1)
    if bins > 1 and (camera.width // bins, camera.height // bins) == (width, height):
        numbers = _numbers(_binned(camera, bins))
        mend.append(f'if they are binned {bins} x {bins} (binning_x, binning_y): {numbers}')
    if width <= camera.width and height <= camera.height:
        centre = f'cx = {cx:.2f} - x_offset, cy = {cy:.2f} - y_offset of the region'
        mend.append(f'if they are a region of the detector (roi): {centre}')
    mend = mend or [f'the focal length in their pixels; it has fx, fy = {fx:.2f}, {fy:.2f}']
    of_file = f'{_OF_FILE}image_width: {width}, image_height: {height}, and '
    return Diagnosis(
        'wrong_size',
        None,
        f'The images are {width} x {height}, the prior camera is of {camera.width} x'
        f' {camera.height}.',
        (looked, 'no pattern of them was found in the sky, which would show the focal length'),
        (of_file + '; '.join(mend),),
    )


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


def _held_against(shown: Shown) -> Diagnosis:
    """The causes where images were identified, the one that hides the others first."""
    solved = shown.solved
    worst = max(image.sky.log10_p_value for image in solved)
    stars = [len(image.sky.xy_px) for image in solved]
    identified = f'{len(solved)} of {shown.tried} images identified without attitude'
    # A smaller bound is no better evidence.
    chance = f'expected false matches: under 10^{max(worst, -12.0):.0f} each'
    evidence = [f'{identified}, {min(stars)} to {max(stars)} stars each; {chance}']
    if shown.reading is not None:
        evidence += _agreement(shown.reading, shown.case)
    prior_px = float(shown.setup.prior.camera.parameters[0])
    known = f', the prior {prior_px:.1f}' if _states_camera(shown) else ''
    evidence.append(f'the images show a focal length of {shown.focal_px:.1f} px{known}')
    findings = [
        finding
        for hypothesis in HYPOTHESES
        if hypothesis.needs(shown)
        for finding in hypothesis.test(shown)
    ]
    joined = _joined(findings, evidence, shown)
    return replace(joined, images=0 if shown.reading is None else shown.reading.agreeing)


def _joined(findings: Sequence[Diagnosis], evidence: list[str], shown: Shown) -> Diagnosis:
    """The first of the findings, with the remedies of all of them."""
    if not findings:
        return Diagnosis('none', None, _fitting(shown), tuple(evidence))
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


def _fitting(shown: Shown) -> str:
    """Sentence on what was held against the stars, and fits."""
    if shown.has_attitudes and shown.refused == 'no_match':
        return 'Attitudes, alignment and camera fit, but a measurement matches no stars with them.'
    if shown.has_attitudes:
        return 'Attitudes, alignment and camera fit the images.'
    if _states_camera(shown):
        return 'The camera fits the images, which have no attitudes.'
    return 'The images show stars of the catalog; no camera and no attitudes are stated.'


def _agreement(reading: Reading, case: Case) -> list[str]:
    """Evidence for a reading, and against the one set up where that is another."""
    alike = f'give one alignment to {math.degrees(reading.scatter_rad):.3f} degrees'
    of = f'{reading.agreeing} of {len(case.time_ns)} images'
    lines = [f'read as {reading}, the attitudes of {of} {alike}']
    given = case.usual_readings()[0]
    if reading.meaning != given.meaning:
        agree = f'those of {given.agreeing} agree to {math.degrees(given.scatter_rad):.3f} degrees'
        if given.agreeing < 2:
            agree = 'no two agree'
        lines.append(f'read as {given}, as they are now, {agree}')
    return lines


class Hypothesis(NamedTuple):
    """
    A possible mistake, as `Diagnosis.cause`; what it needs to be tested; and the test.

    The test gives a diagnosis where the stars show it.
    """

    cause: str
    needs: Callable[[Shown], bool]
    test: Callable[[Shown], Sequence[Diagnosis]]


def _always(shown: Shown) -> bool:
    return True


def _is_read(shown: Shown) -> bool:
    return shown.reading is not None


def _lacks_attitudes(shown: Shown) -> bool:
    return shown.setup.has_tracker and not shown.has_attitudes


def _is_not_read(shown: Shown) -> bool:
    return shown.has_attitudes and shown.reading is None and not shown.is_mirrored


def _states_camera(shown: Shown) -> bool:
    """True if the prior camera is not the one that the stars have given."""
    return shown.setup.has_tracker or bool(shown.setup.frames.camera_info_url)


def _is_aligned_by(shown: Shown) -> bool:
    """True if the alignment shown can be held against the one stated."""
    if shown.reading is None or shown.is_mirrored or shown.solved[0].quarter_turned:
        return False
    if not shown.centre_is_free:
        return not shown.reading.alike
    # A principal point that is not stated, and that the stars leave open, turns the alignment.
    reach_rad, _ = shown.setup.star_search.reach_rad(shown.setup.prior.camera)
    return _SIGMAS * max(shown.free.centre_sigma_px) < reach_rad * shown.focal_px


# Each of the following is one cause; a list is empty where there is nothing wrong.


def _mirrored(shown: Shown) -> list[Diagnosis]:
    if not shown.is_mirrored:
        return []
    how, prior = 'left to right', prior_alignment(shown.setup)
    if shown.reading is not None and prior is not None:
        _, roll_rad = shown.reading.off_by(prior)
        if abs(roll_rad) > math.radians(135.0):
            how = 'top to bottom'
    return [
        Diagnosis(
            'mirrored',
            how,
            f'The image is mirrored {how}.',
            ('the patterns of the sky are there when the image is mirrored, not as it is',),
            (f'# {_NO_PARAMETER}mirror the images {how} where they are read out',),
        )
    ]


def _order(shown: Shown) -> list[Diagnosis]:
    assert shown.reading is not None
    meaning = shown.reading.meaning
    if meaning.numbers == XYZW:
        return []
    mend = (f'# {_NO_PARAMETER}send x, y, z, w in the fields of that name',)
    if meaning.numbers == W_FIRST:
        sentence = 'The attitude quaternions are sent with w first; the message has x, y, z, w.'
        return [Diagnosis('quaternion_order', 'wxyz', sentence, mend=mend)]
    reversed_axes = [name[1:] for name in meaning.numbers.split(', ') if name[0] == '-']
    evidence = []
    if len(reversed_axes) == 2 and sorted(meaning.numbers.replace('-', '')) == sorted(XYZW):
        (axis,) = set('xyz') - set(reversed_axes)
        evidence.append(f'so are those of left-handed axes, with {axis} reversed')
    sentence = f'The fields x, y, z, w of the attitudes hold {meaning.numbers}.'
    return _or_alike(
        Diagnosis('quaternion_order', meaning.numbers, sentence, (), mend), shown, evidence
    )


def _or_alike(diagnosis: Diagnosis, shown: Shown, evidence: Sequence[str] = ()) -> list[Diagnosis]:
    """A diagnosis with the other readings that explain the stars equally."""
    assert shown.reading is not None
    if others := shown.reading.alike:
        listed = '; '.join(map(str, others))
        evidence = [*evidence, f'the stars fit equally well read as: {listed}']
        sentence = f'{diagnosis.sentence[:-1]}, or are {listed}.'
        diagnosis = replace(diagnosis, sentence=sentence)
    return [replace(diagnosis, evidence=(*diagnosis.evidence, *evidence))]


def _direction(shown: Shown) -> list[Diagnosis]:
    assert shown.reading is not None
    given, meaning = shown.setup.attitude.attitude_direction, shown.reading.meaning
    if meaning.direction == given:
        return []
    sentence = f'The attitude quaternions are {meaning}, not {given}.'
    mend = f'attitude_direction: {meaning.direction}'
    return [Diagnosis('attitude_direction', meaning.direction, sentence, mend=(mend,))]


def _axes(shown: Shown) -> list[Diagnosis]:
    assert shown.reading is not None
    meaning = shown.reading.meaning
    if not meaning.axes:
        return []
    sentence = f'The attitudes are in axes of {meaning.axes}, not of the ICRF.'
    mend = (f'# {_NO_PARAMETER}send attitudes in axes of the ICRF (J2000)',)
    return _or_alike(Diagnosis('axes', meaning.axes, sentence, (), mend), shown)


def _clock(shown: Shown) -> list[Diagnosis]:
    assert shown.reading is not None
    shift_s, setup = shown.shift_s + shown.reading.shift_s, shown.setup
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
    evidence = ['the attitude at the shifted stamps gives one alignment, at others not']
    evidence += [
        f'{abs(shift_s):.0f} s is {name}, of clocks in two time scales'
        for step_s, name in _CLOCKS.items()
        if abs(abs(shift_s) - step_s) < _SAME_CLOCK_S
    ]
    zones = round(abs(shift_s) / _ZONE_S)
    if 0 < zones * _ZONE_S < _SAME_DATE_S and abs(abs(shift_s) - zones * _ZONE_S) < _SAME_CLOCK_S:
        evidence.append(f'{zones * _ZONE_S / 3600:g} h is the difference of two time zones')
    return [Diagnosis('clock', offset_s, sentence, tuple(evidence), tuple(mend))]


def _no_attitudes(shown: Shown) -> list[Diagnosis]:
    sentence = 'There are no attitudes of the star tracker to hold against the images.'
    mend = '# record attitudes from before the first image to after the last'
    return [Diagnosis('no_attitude', None, sentence, mend=(mend,))]


def _frozen(shown: Shown) -> list[Diagnosis]:
    angle_rad = shown.case.turned_by_frozen_attitudes()
    if angle_rad is None:
        return []
    return [
        Diagnosis(
            'frozen_attitude',
            round(math.degrees(angle_rad), 2),
            f'The attitudes stay the same while the stars turn by {math.degrees(angle_rad):.1f}'
            ' degrees.',
            mend=(f'# {_NO_PARAMETER}record the attitudes that the star tracker measures',),
        )
    ]


def _no_reading(shown: Shown) -> list[Diagnosis]:
    """No cause can be named where no reading of the attitudes is the right one."""
    case = shown.case
    if case.turned_by_frozen_attitudes() is not None:
        return []
    several = [r for r in case.usual_readings() if r.agreeing == len(case.time_ns)]
    if len(several) > 1:
        return [
            Diagnosis(
                'unknown',
                None,
                'The stars are identified, but attitudes that do not turn leave open how they are'
                ' meant, and prior_alignment goes with no way to read them.',
                (f'the images give one alignment read as {" and ".join(map(str, several))}',),
                ('# give a bag in which the spacecraft turns, or a prior_alignment to 1 degree',),
            )
        ]
    tested = 'two orders and two directions of the numbers'
    if len(case.time_ns) >= IMAGES_OF_A_READING:
        tested = (
            'every order, sign and direction of the numbers, any fixed inertial axes, the rotating'
            f' Earth, clocks up to {CLOCK_SEARCH_S:.0f} s or by time zones apart'
        )
    else:
        tested += f'; clocks and inertial axes need {IMAGES_OF_A_READING} images with attitudes'
    evidence = [f'tested: {tested}; none gives one alignment for most of the images']
    sentence = 'The stars of the images are identified, but the attitudes do not go with them'
    if turns := case.turns():
        by_stars, by_attitudes = (f'{math.degrees(angle):.1f}' for angle in turns)
        sentence += f': the stars turn by {by_stars} degrees, the attitudes by {by_attitudes}'
    else:
        sentence += ': there are none at the stamps of two images'
    mend = ('# check that the attitudes belong to this spacecraft, star tracker and time',)
    return [Diagnosis('unknown', None, f'{sentence}.', tuple(evidence), mend)]


def _sides_exchanged(shown: Shown) -> list[Diagnosis]:
    if not shown.solved[0].quarter_turned:
        return []
    prior = prior_alignment(shown.setup)
    way, back = 'clockwise', 'counterclockwise'
    if prior is not None and shown.reading and shown.reading.quarter_turns(prior) == 2:
        way, back = back, way
    return [
        Diagnosis(
            'rotated',
            90.0,
            f'The image is rotated by 90 degrees {way}.',
            ('its sides are those of the prior camera exchanged',),
            (f'# {_NO_PARAMETER}turn the images {back} where they are read out',),
        )
    ]


def _rotated(shown: Shown) -> list[Diagnosis]:
    reading, prior = shown.alignment, prior_alignment(shown.setup)
    if reading is None or prior is None or not reading.is_off(prior, shown.setup):
        return []
    turns = reading.quarter_turns(prior)
    if not turns:
        return []
    degrees = 180.0 if turns == 2 else 90.0
    way = {1: ' counterclockwise', 2: '', 3: ' clockwise'}[turns]
    sentence = f'The image is rotated by {degrees:.0f} degrees{way} against prior_alignment.'
    return [
        Diagnosis(
            'rotated', degrees, sentence, _away(reading, prior, shown.setup), _aligned(reading)
        )
    ]


def _alignment(shown: Shown) -> list[Diagnosis]:
    reading, prior, setup = shown.alignment, prior_alignment(shown.setup), shown.setup
    assert reading is not None
    values = _values(reading)
    if prior is None:
        sentence = 'prior_alignment is not given; the images show it.'
        return [Diagnosis('prior_alignment', values, sentence, (), _aligned(reading))]
    if not reading.is_off(prior, setup) or reading.quarter_turns(prior):
        return []
    alignment = reading.star_tracker_from_camera
    tilt_deg, roll_deg = (math.degrees(angle) for angle in reading.off_by(prior))
    evidence = list(_away(reading, prior, setup))
    if (prior * alignment).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is the inverse of it: camera from star tracker')
    w_first = Rotation.from_quat(prior.as_quat()[[1, 2, 3, 0]])
    if (w_first.inv() * alignment).magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('prior_alignment is given with w first')
    if alignment.magnitude() < _SAME_ALIGNMENT_RAD:
        evidence.append('the attitudes are those of the camera itself')
    tilt_px = math.radians(tilt_deg) * shown.focal_px
    sigma_px = max(shown.free.centre_sigma_px)
    if _SIGMAS * sigma_px > tilt_px and tilt_px < _FREE * shown.free.camera.width:
        evidence.append(
            f'a principal point that is off by {tilt_px:.0f} px would look the same: check cx, cy'
        )
    stated = setup.identification.prior_alignment_sigma_deg
    sentence = (
        f'prior_alignment points {tilt_deg:.3g} degrees away from where the images show the'
        f' camera, and is rolled by {roll_deg:.3g} degrees; prior_alignment_sigma_deg: {stated:g}.'
    )
    return [Diagnosis('prior_alignment', values, sentence, tuple(evidence), _aligned(reading))]


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


def _numbers(camera: CameraModel) -> str:
    """Focal lengths and principal point of a camera for a camera file."""
    fx, _, fy, cx, cy = (float(value) for value in camera.intrinsics)
    return f'fx, fy, cx, cy = {fx:.2f}, {fy:.2f}, {cx:.2f}, {cy:.2f}'


def _size(shown: Shown) -> list[Diagnosis]:
    """Images of another size than the prior camera: binned, a region, or of another mode."""
    if not shown.is_of_another_size:
        return []
    camera, prior = shown.free.camera, shown.setup.prior.camera
    sizes = (
        f'{camera.width} x {camera.height}, the prior camera is of {prior.width} x {prior.height}'
    )
    evidence = [f'their focal length is that of the prior camera over {shown.bins}']
    of_file = f'{_OF_FILE}image_width: {camera.width}, image_height: {camera.height}, '
    what = f'binned {shown.bins} x {shown.bins} (binning_x, binning_y of CameraInfo)'
    numbers = _numbers(shown.stated)
    if shown.bins == 1:
        what = 'a region of the detector (roi of CameraInfo)'
        cx, cy = (float(value) for value in prior.parameters[3:5])
        numbers = f'cx = {cx:.2f} - x_offset, cy = {cy:.2f} - y_offset of the region'
        place = ', '.join(f'{value:.0f}' for value in camera.parameters[3:5])
        sigma_px = max(shown.free.centre_sigma_px)
        evidence.append(f'the images show the principal point at ({place}) to {sigma_px:.0f} px')
    elif not shown.bins:
        what, evidence = 'another mode', []
        numbers = f'fx = fy = {shown.focal_px:.1f}, and its principal point'
    return [
        Diagnosis(
            'wrong_size',
            shown.bins or None,
            f'The images are {sizes}: {what}.',
            tuple(evidence),
            (f'{of_file}{numbers}',),
        )
    ]


def _focal_length(shown: Shown) -> list[Diagnosis]:
    focal_px, prior = shown.focal_px, shown.setup.prior.camera
    prior_px = float(prior.parameters[0])
    if shown.is_of_another_size or abs(focal_px / prior_px - 1.0) <= _FOCAL_SHARE:
        return []
    sentence = (
        f'The focal length of the prior camera, {prior_px:.0f} px, is'
        f' {abs(100 * (prior_px / focal_px - 1)):.0f} % too'
        f' {"short" if focal_px > prior_px else "long"}.'
    )
    mend = f'{_OF_FILE}fx = fy = {focal_px:.1f}'
    evidence = []
    if shown.stated is not prior:
        sentence = f'{sentence[:-1]}: its camera matrix is of pixels before {shown.bins} x'
        sentence += f' {shown.bins} binning.'
        evidence = ['focal length and principal point are those of binned pixels']
        mend = f'{_OF_FILE}{_numbers(shown.stated)}'
    return [Diagnosis('focal_length', round(focal_px, 2), sentence, tuple(evidence), (mend,))]


def _principal_point(shown: Shown) -> list[Diagnosis]:
    if not shown.centre_is_off:
        return []
    centre = [round(float(value), 1) for value in shown.free.camera.parameters[3:5]]
    stated = ', '.join(f'{value:.1f}' for value in shown.stated.parameters[3:5])
    sigma_px = max(shown.free.centre_sigma_px)
    off_px = float(np.hypot(*shown.centre_off_px))
    return [
        Diagnosis(
            'principal_point',
            centre,
            f'The principal point of the prior camera, ({stated}), is {off_px:.0f} px from where'
            f' the images show it, ({centre[0]}, {centre[1]}).',
            (
                f'the shape of the field shows it to {sigma_px:.1f} px',
                'a camera matrix of the whole detector with the size of a region looks so',
            ),
            (f'{_OF_FILE}cx = {centre[0]}, cy = {centre[1]}',),
        )
    ]


def _tone_curve(shown: Shown) -> list[Diagnosis]:
    slope, sigma = _brightness_slope(shown) or (1.0, 0.0)
    least, most = _LINEAR_SLOPES
    if least <= slope + _SIGMAS * sigma and slope - _SIGMAS * sigma <= most:
        return []
    sentence = 'The images are not linear in the light: they have been through a tone curve.'
    mend = f'# {_NO_PARAMETER}record raw images'
    if slope > most:
        sentence = 'The images were linear, and a tone curve that they never had was undone.'
        mend = f'# {_NO_PARAMETER}give linear images as FITS, or with 16 bits'
    evidence = (
        f'measured brightness grows with catalog brightness to the power {slope:.2f} ± {sigma:.2f}'
    )
    return [Diagnosis('not_linear', round(slope, 2), sentence, (evidence,), (mend,))]


def _brightness_slope(shown: Shown) -> tuple[float, float] | None:
    """Power of the catalog's light that unsaturated stars follow, and its sigma; None: unknown."""
    images = []
    for image in shown.solved:
        place = {tuple(xy): k for k, xy in enumerate(image.sources.xy_px.tolist())}
        rows = np.array([place.get(tuple(xy), -1) for xy in image.sky.xy_px.tolist()], np.int64)
        peak_dn = image.sources.peak_dn
        good = (rows >= 0) & (peak_dn[rows] < 0.8 * peak_dn.max(initial=0.0))
        stars = shown.setup.catalog.magnitude[image.sky.catalog_index[good]]
        if len(stars) >= _FEW_IN_AN_IMAGE:
            images.append((-0.4 * stars, np.log10(image.sources.flux_dn[rows[good]])))
    # Theil and Sen: outliers are variables, doubles and saturated stars.
    slopes = []
    for catalog, measured in images:
        i, j = np.triu_indices(len(catalog), 1)
        far = np.abs(catalog[i] - catalog[j]) > _FAR_DEX
        slopes.append((measured[i] - measured[j])[far] / (catalog[i] - catalog[j])[far])
    if not slopes or not len(np.concatenate(slopes)):
        return None
    slope = float(np.median(np.concatenate(slopes)))
    off = [measured - slope * catalog for catalog, measured in images]
    scatter = MAD_TO_SIGMA * np.median(np.abs(np.concatenate([o - np.median(o) for o in off])))
    spread = sum(float(((catalog - catalog.mean()) ** 2).sum()) for catalog, _ in images)
    return slope, float(scatter) / math.sqrt(spread)


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
)
"""Possible mistakes where images are identified, the one that hides the others first."""
CAUSES = (
    *('none', 'smear', 'no_stars', 'refused'),
    *dict.fromkeys(hypothesis.cause for hypothesis in HYPOTHESES),
)
