# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The gate: limits that a calibration must meet to become active, and their checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.special import ndtri

from starcal_ros.assessment.lookup import movement
from starcal_ros.assessment.remedies import REMEDIES, remedy_against
from starcal_ros.assessment.requirements import maps_of, requirement_checks
from starcal_ros.estimation.limits import FALSE_ALARM_RATE
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.problem import camera_at
from starcal_ros.estimation.unknowns import CHANGE, prior_test_of
from starcal_ros.options import option
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    GateCheck,
    HeldTerm,
    ModelChecks,
    ResidualBin,
    StarTrackerAlignment,
)
from starcal_ros.text import p_value_text, significant

# From a prior the limit on the map is five times that from a calibration, or on a large detector
# a tenth of the half diagonal, by which the prior of the lens moves the corners (`lens_prior`).
_PRIOR_FACTOR, _PRIOR_FACTOR_PER_PX = 5.0, 0.01
_PRIOR_ROTATION = 13.0  # to 5.2 degrees by default: mounts are off by 1.5, and by 5 in roll


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

    The note explains a limit that is not the value of the option; of a check that failed, it has
    the remedy too.
    """
    limit = factor * float(getattr(options, option)) + more
    # The condition is the one that must hold, so that NaN fails: a comparison with it is false.
    passed = found >= limit if option.startswith('min_') else found <= limit
    origin = ''
    if (factor, more) != (1.0, 0.0):
        added = f' and {significant(more, 2)} {unit}' if more else ''
        origin = f'limit: {significant(factor, 3)} times {option}{added}'
    note = '; '.join(filter(None, [origin, '' if passed else remedy]))
    return GateCheck(name, option, float(found), limit, unit, bool(passed), note)


def _unless_noise(check: GateCheck, is_noise: bool, statistic: str = '') -> GateCheck:
    """Return a check that passes too if noise explains the value; its note has the statistic."""
    passed = bool(check.passed) or is_noise
    note = '; '.join(filter(None, [statistic, '' if passed else check.note]))
    return dataclasses.replace(check, passed=passed, note=note)


def _unless_chance(check: GateCheck, p_value: float, tests: int = 1) -> GateCheck:
    """Return one of some checks, which fails for a significant value alone."""
    is_chance = p_value >= FALSE_ALARM_RATE / tests and not math.isnan(check.found)
    return _unless_noise(check, is_chance, f'p-value {p_value_text(p_value)}')


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
        *requirement_checks(calibration, options.requirements),
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


def _fact(name: str, note: str, passed: bool | None) -> GateCheck:
    """Return a check without a number and a limit; its note is the reason where it failed."""
    return GateCheck(name, '', math.nan, math.nan, '', passed, note)


def _solver(calibration: Calibration) -> GateCheck:
    note = ''
    if calibration.termination != 'converged':
        note = (
            f'the solver did not converge ({calibration.termination}); check lens_model and the'
            ' prior camera, and that all images are of one camera'
        )
    return _fact('solver converged', note, not note)


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
    return _fact('numbers finite, variances positive', note, not note)


def _fit(
    calibration: Calibration, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Outliers, the number of images that fit, and their coverage of the detector."""
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
    has_stars = maps_of(calibration).stars > 0
    found = float(has_stars.mean()) if has_stars.size else 0.0
    name, remedy = 'fraction of the detector with stars that fit', REMEDIES['coverage']
    yield limit_check(options, 'min_coverage', name, found, remedy=remedy)


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
    before, name, factors, centre_deg = prior, 'the active calibration', (1.0, 1.0), 0.0
    if active is not None:
        thermal = calibration.temperature
        before = camera_at(active, thermal.reference_degc) if thermal else active.geometry
    else:
        name, camera = 'the prior', prior.camera
        half_px = 0.5 * math.hypot(camera.width, camera.height)
        factors = max(_PRIOR_FACTOR, _PRIOR_FACTOR_PER_PX * half_px), _PRIOR_ROTATION
        centre_px = estimation.principal_point_prior * max(camera.width, camera.height)
        centre_deg = math.degrees(centre_px / abs(camera.parameters[0]))
    rotation_rad, left_px = movement(before, calibration.geometry)
    lens = 'the prior camera or lens_model does not match this lens'
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
            check = limit_check(
                options,
                'max_star_tracker_drift_arcsec',
                f'drift of the attitude of {one.frame} against the stars',
                one.drift_arcsec,
                'arcsec',
                'leave it out of more_star_trackers, or use a shorter time',
            )
            yield _unless_chance(check, one.drift_p_value, len(found))


def model_gate(found: ModelChecks | None, options: GateOptions) -> Iterator[GateCheck]:
    """Contradictions between the stars and the model with its priors, each with the remedy."""
    if found is None:
        return
    for one in found.statements:
        yield _fact(f'{one.name} as stated', one.note, one.passed)
    wrong = [one.name for one in found.statements if one.passed is False]
    # A distance that the evidence does not decide on may be the cause all the same.
    wrong += [t.name for t in found.held if t.distance > options.max_held_term_sigma]
    remedy = remedy_against(CHANGE)
    if wrong:
        remedy = f'a wrong {wrong[0]} looks like it: first correct that'
    yield limit_check(
        options,
        'max_image_variation_px',
        'change of the camera from image to image in a corner',
        found.image_variation_px,
        'px',
        remedy,
    )
    step = found.step
    check = limit_check(
        options,
        'max_detector_step_px',
        f'step of the detector in {step.moved} at {step.across} = {step.place_px:.0f}',
        abs(step.size_px),
        'px',
        REMEDIES['detector step'],
    )
    yield _unless_chance(check, step.p_value)
    yield from (_held_check(term, found, options) for term in found.held)


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
        return dataclasses.replace(check, passed=None, note='the stars alone do not determine it')
    test, estimated = prior_test_of(term.name), significant(term.estimated, 6)
    note, remedy = f'{estimated} by the stars, {significant(term.assumed, 6)} assumed', test.remedy
    if test.unstated and not any(one.name in test.starts for one in found.statements):
        note, remedy = test.unstated
    elif test.is_added:
        note = f'the stars add {estimated} to it'
    return dataclasses.replace(check, note=note if check.passed else f'{note}; {remedy}')


def _group(part: ResidualBin) -> str:
    first = 1 if part.by == 'image' else 0  # images are numbered from 1 on the report
    return f'{part.by} {part.low + first:.4g} to {part.high + first:.4g}'


def _predicted(found: ModelChecks | None, options: GateOptions) -> Iterator[GateCheck]:
    """The part of the data with the largest ratio of residuals to their predicted sigma."""
    bins = found.predictions if found else ()
    if not bins:
        return

    sigmas = -float(ndtri(FALSE_ALARM_RATE / len(bins)))

    def excess(part: ResidualBin) -> float:
        # The noise of a few stars must not fail a part.
        return part.normalised - sigmas * part.sigma

    worst = max(bins, key=excess)
    check = limit_check(
        options,
        'max_cross_validated_residual',
        f'residual over predicted sigma at {_group(worst)}',
        worst.normalised,
        remedy='the sigma is wrong there: check the PSF, the lens model or its images',
    )
    yield _unless_noise(check, excess(worst) <= options.max_cross_validated_residual)
