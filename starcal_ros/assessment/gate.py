# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The gate: limits that a calibration must meet to become active, checks, and remedies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import dataclasses
from dataclasses import dataclass
import math
import re

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import movement
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.camera import INTRINSIC_NAMES
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import camera_at
from starcal_ros.estimation.unknowns import CHANGE, prior_test_of, remedy_of
from starcal_ros.options import option
from starcal_ros.record_fields import nearest
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    Calibration,
    CameraGeometry,
    GateCheck,
    HeldTerm,
    ModelChecks,
    ResidualBin,
    SigmaPart,
    StarTrackerAlignment,
    TOTAL,
)
from starcal_ros.text import p_value_text, significant
from starcal_ros.untrusted import shown

# From a prior the limit on the map is five times that from a calibration, or on a large detector
# a tenth of the half diagonal, by which the prior of the lens moves the corners (`lens_prior`).
_PRIOR_FACTOR, _PRIOR_FACTOR_PER_PX = 5.0, 0.01
_PRIOR_ROTATION = 13.0  # to 5.2 degrees by default: mounts are off by 1.5, and by 5 in roll
_DRIFT_P_VALUE = 1e-4  # false-alarm rate of the drift test; few images support no smaller one
_STEP_P_VALUE = 1e-6  # false-alarm rate of the test for a step, over all places of the detector
_NOT_BY_STARS = 'the stars alone do not determine it'
_PART_SIGMAS = 3.5  # one of twelve parts exceeds it by noise in 1 of 200 calibrations


@dataclass(frozen=True)
class GateOptions:
    """Limits of the gate: a calibration that exceeds one is not activated."""

    max_rejected_fraction: float = option(
        0.25,
        'largest fraction of stars rejected as outliers, and of images with an attitude that'
        ' contradicts the other images',
        low=0.0,
        high=1.0,
    )
    min_coverage: float = option(
        0.3, 'smallest fraction of detector cells with a star used', low=0.0, high=1.0
    )
    requirements: tuple[str, ...] = option(
        ('line_of_sight=300arcsec', 'map=0.5px'),
        'upper limits of 1-sigmas, NAME=LIMIT; NAME: line_of_sight (in the star tracker frame) or'
        ' map (common rotation removed), over the detector or a share of it, @98%; pointing (rms'
        ' over the detector), f, or a parameter; LIMIT in arcsec or px; none: no requirement',
    )
    max_change_px: float = option(
        10.0,
        'largest change of the distortion map from the active calibration, common rotation'
        ' removed, px; without one five times as much from the prior, or as many times as half of'
        ' the diagonal has hundreds of px',
        low=0.0,
        high=1e5,
    )
    max_rotation_deg: float = option(
        0.4,
        'largest rotation of the lines of sight from the active calibration in the star tracker'
        ' frame, degrees; without one 13 times as much from the prior, and the angle of 3 % of the'
        ' longer image side',
        low=0.0,
        high=180.0,
    )
    max_held_term_sigma: float = option(
        5.0,
        'largest difference between the prior and the estimate from the stars, in sigma, for each'
        ' unknown that is held or has a stated prior',
        low=0.0,
        high=1e6,
    )
    max_detector_step_px: float = option(
        0.2, 'largest step between two parts of the detector, px', low=0.0, high=1e5
    )
    max_image_variation_px: float = option(
        0.3,
        'largest 1-sigma change of the camera from image to image at a detector corner, px;'
        ' smaller ones are in the covariance of the camera that images share',
        low=0.0,
        high=1e5,
    )
    max_cross_validated_residual: float = option(
        1.2,
        'largest RMS of residuals over their predicted sigma in any group of stars (by radius,'
        ' magnitude or time), with each image predicted from the others',
        low=1.0,
        high=100.0,
    )
    max_star_tracker_drift_arcsec: float = option(
        30.0,
        'largest drift of each star tracker over its own images, if there are several, arcsec',
        low=0.0,
        high=648000.0,
    )


def limit_check(
    options: GateOptions | CalibrationOptions,
    option: str,
    name: str,
    found: float,
    unit: str = '',
    remedy: str = '',
    factor: float = 1.0,
    more: float = 0.0,
) -> GateCheck:
    """
    A value against a multiple of the limit of an option, and something more.

    The remedy is the note of a check that failed.
    """
    limit = factor * float(getattr(options, option)) + more
    # The condition is the one that must hold, so that NaN fails: a comparison with it is false.
    passed = found >= limit if option.startswith('min_') else found <= limit
    note = '' if passed else remedy
    return GateCheck(name, option, float(found), limit, unit, bool(passed), note)


def _worse(*checks: GateCheck) -> GateCheck:
    """Return the check with the larger share of its limit: limits on one question are one row."""

    def share(check: GateCheck) -> float:
        part = check.found / max(check.limit, 1e-300)
        return math.inf if math.isnan(part) else part

    return max(checks, key=share)


def judge(
    calibration: Calibration,
    prior: CameraGeometry,
    active: Calibration | None,
    options: GateOptions,
    estimation: CalibrationOptions,
) -> tuple[GateCheck, ...]:
    """
    The checks of the gate on a calibration, each with the value found and whether it passed.

    Raises ValueError when the calibration has no maps.

    Parameters
    ----------
    calibration : Calibration
        With its `DetectorMaps`; its verdict is not used.
    prior : CameraGeometry
        Camera and alignment before the calibration.
    active : Calibration or None
        The calibration that this one would replace.
    estimation : CalibrationOptions
        The options of the calibration; they hold some of the limits.

    Returns
    -------
    tuple of GateCheck
        Only the first two if a parameter or a variance is not finite, because the others use them.
    """
    checks = (_solver(calibration), _numbers(calibration))
    if not checks[-1].passed:
        return checks
    # Causes come before their effects: the first reason of a refusal is what to mend.
    return (
        *checks,
        *model_gate(calibration.model_checks, options),
        *star_tracker_gate(calibration.star_trackers, options),
        *_fit(calibration, options, estimation),
        *_precision(calibration, options),
        _changes(calibration, prior, active, options, estimation),
        *_predicted(calibration.model_checks, options),
    )


def reasons_of(checks: Iterable[GateCheck]) -> tuple[str, ...]:
    """A sentence for each failed check; empty if all passed."""
    return tuple(_reason(check) for check in checks if check.passed is False)


def _reason(check: GateCheck) -> str:
    if not check.option:
        return check.note
    side = 'under' if check.is_least else 'over'
    note = f'; {check.note}' if check.note else ''
    return (
        f'{check.name} is {check.found_text}, {side} the limit of {check.limit_text} '
        f'({check.option}){note}'
    )


def _solver(calibration: Calibration) -> GateCheck:
    passed = calibration.termination == 'converged'
    note = (
        f'the solver did not converge ({calibration.termination}); check lens_model and the prior'
        ' camera, and that all images are of one camera'
    )
    return GateCheck(
        'solver converged', '', math.nan, math.nan, '', passed, '' if passed else note
    )


def _numbers(calibration: Calibration) -> GateCheck:
    values = np.concatenate(
        [
            calibration.geometry.camera.parameters,
            calibration.geometry.star_tracker_from_camera_xyzw,
            calibration.covariance.ravel(),
            [calibration.residual_rms_px],
        ]
    )
    note = ''
    if not np.isfinite(values).all():
        note = 'a parameter, its covariance or the residual is not a finite number'
    elif (np.diag(calibration.covariance) < 0).any():
        note = 'a variance is negative'
    name = 'numbers finite, variances positive'
    return GateCheck(name, '', math.nan, math.nan, '', not note, note)


def _fit(
    calibration: Calibration, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Outliers, and the number of images that fit."""
    stars = max(calibration.stars_used + calibration.stars_rejected, 1)
    images, misfits = calibration.images_used, len(calibration.misfit_images_ns)
    rejected = (
        (calibration.stars_rejected / stars, 'stars left out as outliers'),
        (misfits / max(images, 1), 'images whose attitude does not fit'),
    )
    found, what = max(rejected)
    name, remedy = f'fraction of {what}', REMEDIES[what]
    yield limit_check(options, 'max_rejected_fraction', name, found, remedy=remedy)
    name, remedy = 'number of images that fit', REMEDIES['stars']
    yield limit_check(estimation, 'min_images', name, images - misfits, remedy=remedy)


def _precision(calibration: Calibration, options: GateOptions) -> Iterator[GateCheck]:
    """Coverage of the detector and precision of the result."""
    maps = calibration.maps
    if maps is None:
        raise ValueError('calibration: the gate needs its detector maps')
    yield limit_check(
        options,
        'min_coverage',
        'fraction of the detector with stars that fit',
        float((maps.stars > 0).mean()) if maps.stars.size else 0.0,
        remedy=REMEDIES['coverage'],
    )
    yield from requirement_checks(calibration, options.requirements)


def _changes(
    calibration: Calibration,
    prior: CameraGeometry,
    active: Calibration | None,
    options: GateOptions,
    estimation: CalibrationOptions,
) -> GateCheck:
    """
    Change from the active calibration, or from the prior if none is active.

    An alignment follows the principal point, which a prior has within a part of the image.
    """
    before, name, factors, centre_deg = prior, 'the prior', (_PRIOR_FACTOR, _PRIOR_ROTATION), 0.0
    if active is not None:
        before, name, factors = active.geometry, 'the active calibration', (1.0, 1.0)
        if calibration.temperature is not None:
            before = camera_at(active, calibration.temperature.reference_degc)
    else:
        camera = prior.camera
        half_px = 0.5 * math.hypot(camera.width, camera.height)
        factors = max(_PRIOR_FACTOR, _PRIOR_FACTOR_PER_PX * half_px), _PRIOR_ROTATION
        centre_px = estimation.principal_point_prior * max(camera.width, camera.height)
        centre_deg = math.degrees(centre_px / abs(camera.parameters[0]))
    rotation_rad, left_px = movement(before, calibration.geometry)
    lens = 'the prior camera or its lens model does not match this lens (lens_model)'
    return _worse(
        limit_check(
            options,
            'max_change_px',
            f'largest change of the distortion map from {name}',
            float(left_px.max()),
            'px',
            REMEDIES['change of the camera'] if active else lens,
            factors[0],
        ),
        limit_check(
            options,
            'max_rotation_deg',
            f'rotation of the lines of sight from {name}',
            math.degrees(rotation_rad),
            'deg',
            REMEDIES['change of the mounting' if active else 'mounting of the prior'],
            factors[1],
            centre_deg,
        ),
    )


def star_tracker_gate(
    found: tuple[StarTrackerAlignment, ...], options: GateOptions
) -> Iterator[GateCheck]:
    """The drift of each of several star trackers."""
    for one in found:
        if math.isfinite(one.drift_p_value):
            yield _significant(
                options,
                'max_star_tracker_drift_arcsec',
                f'drift of the attitude of {one.frame} against the stars',
                one.drift_arcsec,
                'arcsec',
                one.drift_p_value,
                'leave it out of more_star_trackers, or use a shorter time',
                _DRIFT_P_VALUE,
            )


def model_gate(found: ModelChecks | None, options: GateOptions) -> Iterator[GateCheck]:
    """Contradictions between the stars and the model with its priors, each with the remedy."""
    if found is None:
        return
    for one in found.statements:
        name = f'{one.name} as stated'
        yield GateCheck(name, '', math.nan, math.nan, '', one.passed, one.note)
    held = [_held_check(term, found, options) for term in found.held]
    wrong = [one.name for one in found.statements if one.passed is False]
    # A distance that the evidence does not decide on may be the cause all the same.
    wrong += [t.name for t in found.held if t.distance > options.max_held_term_sigma]
    remedy = remedy_of(CHANGE)
    yield limit_check(
        options,
        'max_image_variation_px',
        'change of the camera from image to image in a corner',
        found.image_variation_px,
        'px',
        f'a wrong {wrong[0]} looks like it: first correct that' if wrong else remedy,
    )
    step = found.step
    yield _significant(
        options,
        'max_detector_step_px',
        f'step of the detector in {step.moved} at {step.across} = {step.place_px:.0f}',
        abs(step.size_px),
        'px',
        step.p_value,
        REMEDIES['detector step'],
        _STEP_P_VALUE,
    )
    yield from held


def _held_check(term: HeldTerm, found: ModelChecks, options: GateOptions) -> GateCheck:
    """The distance of an assumed value from that by the stars, if they determine it."""
    check = limit_check(
        options,
        'max_held_term_sigma',
        f'distance of {term.name} from its assumed value',
        term.significance,
        'sigma',
    )
    if math.isnan(term.significance):
        return dataclasses.replace(check, passed=None, note=_NOT_BY_STARS)
    note, remedy = of_held(term, found)
    return dataclasses.replace(check, note=note if check.passed else f'{note}; {remedy}')


def of_held(term: HeldTerm, found: ModelChecks) -> tuple[str, str]:
    """Sentences on an assumed value: by the stars, and the remedy if they contradict it."""
    test = prior_test_of(term.name)
    estimated, assumed = significant(term.estimated, 6), significant(term.assumed, 6)
    note = f'{estimated} by the stars, {assumed} assumed'
    if test.unstated and not any(one.name in test.starts for one in found.statements):
        return test.unstated
    return f'the stars add {estimated} to it' if test.is_added else note, test.remedy


def _group(part: ResidualBin) -> str:
    first = 1 if part.by == 'image' else 0  # images are numbered from 1 on the report
    return f'{part.by} {part.low + first:.4g} to {part.high + first:.4g}'


def _predicted(found: ModelChecks | None, options: GateOptions) -> Iterator[GateCheck]:
    """The part of the data with the largest ratio of residuals to their predicted sigma."""
    bins = found.predictions if found else ()
    if not bins:
        return

    def excess(part: ResidualBin) -> float:
        # The noise of a few stars must not fail a part.
        return part.normalised - _PART_SIGMAS * part.sigma

    worst = max(bins, key=excess)
    check = limit_check(
        options,
        'max_cross_validated_residual',
        f'residual over predicted sigma at {_group(worst)}',
        worst.normalised,
    )
    passed = bool(check.passed) or excess(worst) <= options.max_cross_validated_residual
    note = (
        '' if passed else 'the sigma is wrong there: check the PSF, the lens model or its images'
    )
    yield dataclasses.replace(check, passed=passed, note=note)


def _significant(
    options: GateOptions,
    option: str,
    name: str,
    found: float,
    unit: str,
    p_value: float,
    remedy: str,
    least_p_value: float,
) -> GateCheck:
    """A check that fails if the value exceeds its limit and is significant."""
    check = limit_check(options, option, name, found, unit)
    likely = not p_value < least_p_value
    note = f'p-value {p_value_text(p_value)}'
    if not check.passed and not likely:
        note += f'; {remedy}'
    return dataclasses.replace(check, passed=bool(check.passed) or likely, note=note)


REQUIREMENTS, _NONE = 'requirements', 'none'
LINE_OF_SIGHT, MAP, POINTING, FOCAL = 'line_of_sight', 'map', 'pointing', 'f'
_UNITS: dict[str, tuple[str, ...]] = {
    LINE_OF_SIGHT: ('arcsec',),
    MAP: ('arcsec', 'px'),
    POINTING: ('arcsec',),
    **dict.fromkeys([FOCAL, *INTRINSIC_NAMES], ('px',)),
    **dict.fromkeys(ALIGNMENT_NAMES, ('arcsec',)),
    **{name: ('',) for lens in LENSES.values() for name in lens.coefficients},
}
_FORM = re.compile(r'\s*(\w+)\s*=\s*([\d.]+(?:e-?\d+)?)\s*([a-z]*)\s*(?:@\s*([\d.]+)\s*%\s*)?')


@dataclass(frozen=True)
class Requirement:
    """
    An upper limit of a 1-sigma.

    ``quantity`` is ``line_of_sight``, ``map`` (the camera alone, the rotation common to the
    detector removed), each over a ``share`` of the detector; ``pointing`` (lines of sight in the
    star tracker frame, RMS over the detector), ``f`` (both focal lengths), or a parameter.

    >>> Requirement.of('line_of_sight=5arcsec@98%')
    Requirement(quantity='line_of_sight', limit=5.0, unit='arcsec', share=0.98)
    """

    quantity: str
    limit: float
    unit: str
    share: float = 1.0

    @classmethod
    def of(cls, text: str) -> Requirement:
        """Requirement of a text; raises OptionError with what is allowed."""
        match = _FORM.fullmatch(text)
        if match is None:
            raise OptionError(
                f'{REQUIREMENTS}: {shown(text)} is not of the form line_of_sight=5arcsec@98%,'
                ' map=0.1px, pointing=10arcsec or f=0.1px'
            )
        quantity, number, unit, percent = match.groups()
        if quantity not in _UNITS:
            raise OptionError(
                f'{REQUIREMENTS}: {quantity} is not line_of_sight, map, pointing, f or a'
                f' parameter{nearest(quantity, _UNITS)}'
            )
        if unit not in _UNITS[quantity]:
            over = f'@{percent}%' if percent and quantity in (LINE_OF_SIGHT, MAP) else ''
            written = ' or '.join(f'{quantity}={number}{name}{over}' for name in _UNITS[quantity])
            raise OptionError(f'{REQUIREMENTS}: {text}: the unit does not fit: write {written}')
        try:
            limit, share = float(number), float(percent or 100.0) / 100.0
        except ValueError as error:
            raise OptionError(f'{REQUIREMENTS}: {text}: not a number') from error
        if percent and quantity not in (LINE_OF_SIGHT, MAP):
            raise OptionError(
                f'{REQUIREMENTS}: {text}: only line_of_sight and map are over a share'
            )
        if not (0.0 < limit < math.inf and 0.0 < share <= 1.0):
            raise OptionError(
                f'{REQUIREMENTS}: {text}: the sigma must be finite and above 0, and the share at'
                ' most 100 %'
            )
        return cls(quantity, limit, unit, share)

    @property
    def name(self) -> str:
        """The limited sigma in words."""
        what = {
            LINE_OF_SIGHT: '1-sigma of a line of sight',
            MAP: '1-sigma of the distortion map',
            POINTING: 'rms 1-sigma of the pointing',
        }.get(self.quantity, f'1-sigma of {self.quantity}')
        if self.quantity not in (LINE_OF_SIGHT, MAP):
            return what
        return f'{what} over {100 * self.share:g} %' if self.share < 1.0 else f'largest {what}'

    def sigma(self, calibration: Calibration) -> float:
        """The sigma of a calibration in the unit; NaN where a part of it is not known."""
        maps, scale = calibration.maps, 1.0 if self.unit != 'arcsec' else ARCSECOND_RAD
        if maps is None:
            raise ValueError('calibration: the gate needs its detector maps')
        if self.quantity == POINTING:
            budget = calibration.sigma_budget if calibration.has_alignment else ()
            return next((p.pointing_arcsec for p in budget if p.cause == TOTAL), math.nan)
        if self.quantity == LINE_OF_SIGHT:
            # Without an alignment the common rotation has no meaning.
            aligned = calibration.has_alignment
            full = maps.line_of_sight_sigma_arcsec if aligned else maps.shape_sigma_arcsec
            return self._over(full)
        if self.quantity == MAP and self.unit == 'arcsec':
            return self._over(maps.shape_sigma_arcsec)
        if self.quantity == MAP:
            try:
                camera = calibration.geometry.camera
                return self._over(map_sigma_px(camera, calibration.map_covariance))
            except np.linalg.LinAlgError:
                return math.nan
        names = ('fx', 'fy') if self.quantity == FOCAL else (self.quantity,)
        sigma = dict(zip(calibration.parameter_names, calibration.sigma, strict=True))
        # One that is held has no sigma of its own.
        return float(np.max([sigma.get(name, 0.0) or math.nan for name in names])) / scale

    def remedy(self, calibration: Calibration) -> str:
        """The remedy of the largest cause of the sigma, of that of a map where it is worst."""

        def variance(part: SigmaPart) -> float:
            if self.quantity in (POINTING, *ALIGNMENT_NAMES):
                return part.pointing_arcsec**2
            of_map = max(part.map_over_detector_arcsec, default=part.map_arcsec) ** 2
            turned = part.pointing_arcsec**2 - part.map_arcsec**2
            return of_map + turned * (self.quantity == LINE_OF_SIGHT)

        causes = [part for part in calibration.sigma_budget if part.cause != TOTAL]
        return remedy_against(max(causes, key=variance).cause) if causes else ''

    def _over(self, sigma: Floats) -> float:
        """Upper limit of a sigma over the share; NaN where it has none."""
        known = np.where(np.isfinite(sigma), sigma, np.inf)
        limit = float(np.quantile(known, self.share, method='inverted_cdf'))
        return limit if math.isfinite(limit) else math.nan


def requirements_of(texts: Iterable[str]) -> tuple[Requirement, ...]:
    """Requirements of the option, none for ``none``; raises OptionError for any other text."""
    texts = tuple(texts)
    if '' in texts:  # a shell variable that is not set; without the option the defaults hold
        raise OptionError(
            f'{REQUIREMENTS}: an empty text is no requirement: leave the option out for the'
            ' defaults, or write none to require no sigma'
        )
    return () if texts == (_NONE,) else tuple(map(Requirement.of, texts))


def requirement_checks(calibration: Calibration, texts: Iterable[str]) -> Iterator[GateCheck]:
    """
    A check of each requirement, with by how much it is missed and what lowers the sigma.

    Raises ValueError when the calibration has no maps.
    """
    for wanted in requirements_of(texts):
        sigma = wanted.sigma(calibration)
        passed = sigma <= wanted.limit  # NaN is not
        note = 'met' if passed else 'it is not estimated'
        if sigma > wanted.limit:
            unit = wanted.unit and f' {wanted.unit}'
            missed = f'missed by {significant(sigma - wanted.limit, 2)}{unit}'
            note = '; '.join(filter(None, [missed, wanted.remedy(calibration)]))
        yield GateCheck(wanted.name, REQUIREMENTS, sigma, wanted.limit, wanted.unit, passed, note)


def requirement_answers(calibration: Calibration) -> tuple[str, ...]:
    """A sentence on each requirement of a judged calibration: the sigma, the limit, the note."""
    return tuple(
        f'{check.name} {check.found_text}, at most {check.limit_text} required: {check.note}'
        for check in calibration.gate
        if check.option == REQUIREMENTS
    )


def remedy_against(cause: str) -> str:
    """Remedy that lowers the part of a sigma by a cause; empty where there is none."""
    return remedy_of(cause) or REMEDIES.get(cause, '')


REMEDIES: Mapping[str, str] = {
    # Reasons to refuse images (`IMAGE_REFUSALS`).
    'bad_encoding': 'record images of one channel, 8 or 16 bit, raw, as PNG or JPEG',
    'bad_layout': 'correct width, height, step and data where the message is made',
    'bad_stamp': 'stamp the images in UTC since 1970, and check stamp_offset_s',
    'bad_attitude': 'send unit quaternions, and none while the star tracker has no lock',
    'no_attitude': 'record attitudes from before the first image to after the last',
    'attitude_gap': (
        'record attitudes more often, or raise max_attitude_gap_s if the vehicle turns evenly'
    ),
    'frozen_attitude': 'record the attitudes that the star tracker measures',
    'out_of_order': 'use one topic for each camera, and send images in the order of their stamps',
    'overexposed': 'expose for a shorter time',
    'blank': 'check that the camera is read out',
    'frozen': 'check that the camera is read out, and that one publisher sends each frame',
    'duplicate': 'give each image once: a copy adds nothing',
    'incomplete': 'if rows of the detector are dead, raise max_lost_fraction; else mend the link',
    'glare': 'keep Sun, Moon and Earth out of the field',
    'smeared': 'expose for a shorter time, or point more steadily',
    'not_in_catalog': (
        'raise magnitude_limit, or give starcal catalog a table of this sky (docs/mission.md)'
    ),
    'no_match': 'ask starcal diagnose, or setup_finder beside the nodes, for the cause',
    'too_few_stars': (
        'expose for longer, or raise magnitude_limit, with a deeper catalog (starcal catalog) in a'
        ' field of few stars; check bad_pixel_map'
    ),
    # Checks of the gate, with the section of the report.
    'stars left out as outliers': 'look for smeared or misidentified stars (Residuals)',
    'images whose attitude does not fit': 'check their attitudes and stamps (Alignment)',
    'coverage': 'take images with stars in the empty cells (Coverage)',
    'mounting of the prior': 'check the alignment assumed (prior_alignment) and the mounting',
    'change of the camera': 'find out if the camera has changed',
    'change of the mounting': 'find out if the mounting has changed',
    # Faults that the stars show.
    'detector step': 'columns or rows are lost or shifted there: check the read-out',
    # Causes of the sigma of a line of sight (`SigmaPart.cause`) that are no unknowns.
    'stars': 'take more images',
    'fine structure': 'take more images with stars at other places on the detector',
    'star places': 'take images of other star fields, with a catalog that has proper motions',
    'star tracker noise': 'take more images',
    'star tracker slow error': 'take images in more attitudes; try starcal diagnose',
    'held parameters': 'estimate the held parameters (estimate)',
}
"""Name -> remedy; that of a check which failed is in its note, that of an unknown in its row."""
