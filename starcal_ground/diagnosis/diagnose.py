# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Why the images of a set match no star: the set-up held against what the images show by themselves.

Some images are identified without attitude or alignment.  Each gives the true rotation of the
camera, and all together one camera.  `hypotheses.HYPOTHESES` is the table of what can be wrong,
each with what it needs: nothing is named that was not tested.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
import functools
import itertools
import math

import cv2
import numpy as np

from starcal_ground.blind.bright_sources import LONGEST_STREAK_PX, smear
from starcal_ground.blind.common_camera import common_camera
from starcal_ground.blind.images import Identified, identify_images, LOOKED_AT
from starcal_ground.diagnosis.attitude_readings import (
    Case,
    expected_rotations,
    Reading,
    WireAttitudes,
)
from starcal_ground.diagnosis.hypotheses import (
    Finding,
    findings,
    FOCAL_SHARE,
    HALF_OF_IMAGE,
    HYPOTHESES,
    NO_PARAMETER,
    not_sharp,
)
from starcal_ground.diagnosis.image_size import (
    binned,
    camera_of_size,
    centre_of_region,
    numbers_of_file,
    size_of_file,
    sizes_in_words,
    stated_camera,
)
from starcal_ground.diagnosis.shown import shape_of, Shown, StarShape
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import CameraModel
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Image
from starcal_ros.sky.catalog import StarCatalog

IMAGES_OF_AN_ALIGNMENT = 3
CAUSES = (
    *('none', 'smear', 'no_stars', 'refused'),
    *dict.fromkeys(hypothesis.cause for hypothesis in HYPOTHESES),
)
_FEW_SOURCES = 10  # in an image that nothing identifies: hot pixels are sources too
_MOST_BINNED = 8
_HELD = 1e-5  # range, widths, of a principal point that is held
_BLUR_BINS = 4  # discs and rings of 8 to 20 px are one source in bins of so many pixels
_BLUR_EFFORT = 1_500  # 6 to 12 s; such images were identified in 0.2 to 4.5 s
_BINNED_RANGE_DN = 60_000.0  # brightest value of binned pixels, so that rounding adds no noise


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
                advice = line.removeprefix('# ').removeprefix(NO_PARAMETER)
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
    camera = camera_of_size(looked, setup.prior.camera)
    guesses = functools.partial(expected_rotations, attitudes, setup)
    if not setup.has_tracker:
        attitudes = replace(attitudes, time_ns=attitudes.time_ns[:0])
    identified = identify_images(looked, camera, setup.catalog, guesses)
    if not identified.solved:
        cause, finding = _nothing_found(looked, identified, camera, setup)
        return Diagnosis(cause, **vars(finding))
    shown = _shown(identified, camera, attitudes, setup, shift_s, refused)
    return _held_against(shown)


def _shown(
    identified: Identified,
    camera: CameraModel,
    attitudes: WireAttitudes,
    setup: Setup,
    shift_s: float,
    refused: str,
) -> Shown:
    solved, prior = identified.solved, setup.prior.camera
    skies = [image.sky for image in solved]
    free = common_camera(skies, camera, setup.catalog, HALF_OF_IMAGE)
    ratio = float(prior.parameters[0]) / float(free.camera.parameters[0])
    bins = min(max(round(ratio), 1), _MOST_BINNED)
    bins = bins if abs(ratio / bins - 1.0) <= FOCAL_SHARE else 0
    stated = stated_camera(prior, free.camera, bins)
    held = common_camera(skies, stated, setup.catalog, _HELD)
    time_ns = np.array([image.time_ns for image in solved])
    case = Case(time_ns, free.camera_from_icrf.inv(), attitudes, setup)
    tried = len(identified.sources)
    return Shown(solved, tried, case, setup, bins, stated, free, held, shift_s, refused)


def _nothing_found(
    images: Sequence[Image], identified: Identified, searched: CameraModel, setup: Setup
) -> tuple[str, Finding]:
    """The cause where no image was identified."""
    camera, looked_at = setup.prior.camera, identified.sources
    if not looked_at:
        return 'no_stars', Finding(0, 'There is no image that can be read.', ())
    count = int(np.median([len(sources.xy_px) for sources in looked_at]))
    streaks = [streak for streak in map(smear, looked_at) if streak is not None]
    looked = f'{len(looked_at)} images looked at, {count} star-like sources each'
    if 2 * len(streaks) > len(looked_at):
        return 'smear', _smeared(float(np.median([length for length, _ in streaks])), looked)
    if (searched.width, searched.height) != (camera.width, camera.height):
        return 'wrong_size', _of_another_size(searched, camera, looked)
    if shape := _shape_in_bins(images, searched, setup.catalog):
        blurred = not_sharp(shape)
        bins = f'the images are identified in bins of {_BLUR_BINS} x {_BLUR_BINS} pixels only'
        return 'one_shape', replace(blurred, evidence=(looked, bins, *blurred.evidence))
    if count < _FEW_SOURCES:
        level = float(np.median([s.background.level_dn for s in looked_at]))
        noise = float(np.median([s.background.noise_dn for s in looked_at]))
        return 'no_stars', Finding(
            count,
            f'The images show too few stars: {count} sources each, and five have to be stars.',
            (f'# {NO_PARAMETER}expose for longer, or check that the lens sees the sky',),
            (looked, f'background {level:.0f} DN with a noise of {noise:.1f} DN'),
        )
    focal_px = float(camera.parameters[0])
    width_deg = math.degrees(2 * math.atan(camera.width / 2 / focal_px))
    return 'unknown', Finding(
        None,
        'No image can be identified, for a cause that is not known.',
        ('# check camera_info_url: focal length in pixels, size of the image',),
        (
            looked,
            'no pattern of them was found in the sky, mirrored or not, before the search ended',
            f'tried: focal lengths of 0.25 to 4 times {focal_px:.0f} px, {width_deg:.1f} deg wide',
        ),
    )


def _shape_in_bins(
    images: Sequence[Image], camera: CameraModel, catalog: StarCatalog
) -> StarShape | None:
    """Shape of stars too wide to be single sources, which are identified in bins of pixels."""
    coarse = [Image(image.time_ns, _in_bins(image.pixels)) for image in images]
    in_bins = binned(camera, _BLUR_BINS)
    identified = identify_images(coarse, in_bins, catalog, lambda _: (), _BLUR_EFFORT)
    return shape_of(identified.solved, _BLUR_BINS) if identified.solved else None


def _in_bins(pixels: Pixels) -> Pixels:
    """Means of bins of pixels above the darkest one, in steps finer than their noise."""
    height, width = (side // _BLUR_BINS for side in pixels.shape)
    whole = pixels[: height * _BLUR_BINS, : width * _BLUR_BINS].astype(np.float32)
    means = np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))
    light: Floats = means - means.min()
    scale = min(_BLUR_BINS**2, _BINNED_RANGE_DN / max(float(light.max()), 1.0))
    return np.asarray(np.rint(scale * light), np.uint16)


def _of_another_size(images: CameraModel, camera: CameraModel, looked: str) -> Finding:
    """The cause where images of another size than the prior camera's show no known stars."""
    ways = []
    bins = max(camera.width // images.width, 1)
    of_bins = binned(camera, bins)
    if bins > 1 and (of_bins.width, of_bins.height) == (images.width, images.height):
        numbers = numbers_of_file(of_bins)
        ways.append(f'if they are binned {bins} x {bins} (binning_x, binning_y): {numbers}')
    if images.width <= camera.width and images.height <= camera.height:
        centre = centre_of_region(camera)
        ways.append(f'if they are a region of the detector (roi): {centre}')
    if not ways:
        fx, _, fy = (float(value) for value in camera.intrinsics[:3])
        ways.append(f'the focal length in their pixels; it has fx, fy = {fx:.2f}, {fy:.2f}')
    return Finding(
        None,
        f'{sizes_in_words(images, camera)}.',
        (f'{size_of_file(images)}and {"; ".join(ways)}',),
        (looked, 'no pattern of them was found in the sky, which would show the focal length'),
    )


def _smeared(length_px: float, looked: str) -> Finding:
    """The cause where most images show streaks of this length."""
    about = 'about' if length_px < LONGEST_STREAK_PX else 'at least'
    length_px = min(length_px, LONGEST_STREAK_PX)
    return Finding(
        round(length_px, 1),
        f'The stars are streaks {about} {length_px:.0f} px long: the camera moves during the'
        ' exposure.',
        (f'# {NO_PARAMETER}expose for a shorter time, or while not slewing',),
        (looked, 'the sources are more than twice as long as wide, and all point one way'),
    )


def _held_against(shown: Shown) -> Diagnosis:
    """The first of the causes where images were identified, with the remedies of all."""
    found = findings(shown)
    lines = [*_identified(shown), *(line for _, one in found for line in one.evidence)]
    images = 0 if shown.reading is None else shown.reading.agreeing
    if not found:
        return Diagnosis('none', None, _fitting(shown), tuple(lines), images=images)
    (cause, first), *others = found
    return Diagnosis(
        cause,
        first.found,
        first.sentence,
        (*lines, *(f'besides: {other.sentence}' for _, other in others)),
        tuple(line for _, one in found for line in one.mend),
        tuple(name for name, _ in others),
        images,
    )


def _identified(shown: Shown) -> list[str]:
    """Evidence on the images that were identified, and on the reading of their attitudes."""
    worst = max(image.sky.log10_p_value for image in shown.solved)
    stars = [len(image.sky.xy_px) for image in shown.solved]
    identified = f'{len(shown.solved)} of {shown.tried} images identified without attitude'
    # A smaller bound is no better evidence.
    chance = f'expected false matches: under 10^{max(worst, -12.0):.0f} each'
    lines = [f'{identified}, {min(stars)} to {max(stars)} stars each; {chance}']
    if shown.reading is not None:
        lines += _agreement(shown.reading, shown.case)
    prior_px = float(shown.setup.prior.camera.parameters[0])
    known = f', the prior {prior_px:.1f}' if shown.states_camera else ''
    return [*lines, f'the images show a focal length of {shown.focal_px:.1f} px{known}']


def _fitting(shown: Shown) -> str:
    """Sentence on what was held against the stars, and fits."""
    if shown.has_attitudes and shown.refused == 'no_match':
        return 'Attitudes, alignment and camera fit, but a measurement matches no stars with them.'
    if shown.has_attitudes:
        return 'Attitudes, alignment and camera fit the images.'
    if shown.states_camera:
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
