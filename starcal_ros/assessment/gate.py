"""The gate: the limits that a calibration must meet to become active, and the checks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import dataclasses
from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.assessment.agreement import Difference, difference, movement
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import CalibrationOptions
from starcal_ros.options import option
from starcal_ros.records import (
    Calibration,
    calibration_parameter_names,
    CameraGeometry,
    GateCheck,
    HalvesComparison,
    ModelChecks,
)


@dataclass(frozen=True)
class GateOptions:
    """Limits that a calibration must meet to become active."""

    max_residual_rms_px: float = option(
        1.0, 'largest residual per axis over the stars used, px', low=0.0, high=100.0
    )
    max_rejected_fraction: float = option(
        0.25, 'largest fraction of stars left out as outliers', low=0.0, high=1.0
    )
    min_coverage: float = option(
        0.3,
        'smallest fraction of the focal-plane cells with at least one star used',
        low=0.0,
        high=1.0,
    )
    max_map_sigma_px: float = option(
        0.5,
        'largest 1-sigma of the distortion map over the detector, common rotation removed, px',
        low=0.0,
        high=100.0,
    )
    max_change_px: float = option(
        50.0,
        'largest change of the distortion map against the prior, common rotation removed, px',
        low=0.0,
        high=1e5,
    )
    max_rotation_deg: float = option(
        2.0,
        'largest rotation of the lines of sight in the star tracker frame against the prior, deg',
        low=0.0,
        high=180.0,
    )
    max_misfit_fraction: float = option(
        0.3, 'largest fraction of images whose attitude does not fit the others', low=0.0, high=1.0
    )
    max_star_tracker_excess: float = option(
        10.0,
        'largest ratio of the estimated to the assumed star-tracker sigma, around any axis',
        low=1.0,
        high=1e6,
    )
    max_line_of_sight_sigma_arcsec: float = option(
        60.0,
        'largest 1-sigma of a line of sight in the star tracker frame over the detector, arcsec',
        low=0.0,
        high=3600.0,
    )
    max_parameter_sigma: tuple[float, ...] = option(
        (0.0,),
        'largest 1-sigma of fx, skew, fy, cx, cy (px), of the coefficients of the lens model, and'
        " of the alignment around the camera's x, y, z (arcsec); 0: no limit, a single 0: none at"
        ' all',
        low=0.0,
    )
    min_singular_value: float = option(
        1e-4,
        'smallest singular value of the information, scaled to a unit diagonal: below it the'
        ' estimated parameters cannot be separated',
        low=0.0,
        high=1.0,
    )
    max_zero_skew_cost_px: float = option(
        5.0, 'largest error of the camera without skew in camera_info, px', low=0.0, high=1e5
    )
    max_halves_px: float = option(
        1.0,
        'largest difference of the distortion maps of the earlier and the later half of the'
        ' images, common rotation removed, where it is significant, px',
        low=0.0,
        high=1e5,
    )
    max_halves_rotation_arcsec: float = option(
        120.0,
        'largest rotation between the two halves where it is significant, arcsec',
        low=0.0,
        high=648000.0,
    )
    min_halves_p_value: float = option(
        1e-4,
        'p-value below which a difference of the halves is significant: the rate at which the gate'
        ' refuses two halves of one camera; 0: the halves are not compared',
        low=0.0,
        high=1.0,
    )
    max_field_px: float = option(
        20.0,
        'largest displacement of the field that is estimated beside the lens model, px; a field'
        ' that is needed and not estimated exceeds every limit',
        low=0.0,
        high=1e5,
    )
    max_held_term_sigma: float = option(
        5.0,
        'largest distance of a camera parameter that is held, or bound by its prior, from the'
        ' value that the stars give it, in sigma',
        low=0.0,
        high=1e6,
    )
    max_detector_step_px: float = option(
        0.2, 'largest step between two parts of the detector, px', low=0.0, high=1e5
    )
    max_velocity_error_km_s: float = option(
        10.0,
        'largest velocity of the observer that the aberration of the stars misses, km/s',
        low=0.0,
        high=1e5,
    )
    max_image_variation_px: float = option(
        0.3,
        '1-sigma change of the camera from image to image in a corner of the detector, px; a'
        ' smaller one is carried in the covariance',
        low=0.0,
        high=1e5,
    )
    min_independent_images: float = option(
        0.0,
        'smallest number of images with independent star-tracker errors that determine the'
        ' alignment as well; 0: the loss is carried in the covariance alone',
        low=0.0,
        high=1e5,
    )
    min_model_p_value: float = option(
        1e-6,
        'p-value below which a step, a missed velocity or a change from image to image is real',
        low=0.0,
        high=1.0,
    )
    max_step_px: float = option(
        10.0,
        'largest change of the distortion map against the active calibration, common rotation'
        ' removed, px',
        low=0.0,
        high=1e5,
    )
    max_step_rotation_deg: float = option(
        0.5,
        'largest rotation of the lines of sight against the active calibration, deg',
        low=0.0,
        high=180.0,
    )
    max_step_sigma: float = option(
        0.0,
        'largest change against the active calibration in the sigmas of both, RMS over the'
        ' parameters that both estimate; 0: no limit, since a significant change is the reason'
        ' to calibrate again',
        low=0.0,
        high=1e6,
    )


def check_gate_options(options: GateOptions, camera: CameraModel) -> None:
    """
    Raise `OptionError` for limits that do not go with the lens model of a camera.

    Raises
    ------
    OptionError
        Naming the option.
    """
    names, count = calibration_parameter_names(camera), len(options.max_parameter_sigma)
    if count not in (1, len(names)):
        raise OptionError(
            f'max_parameter_sigma: {count} numbers, but there are {len(names)} parameters with '
            f'the lens model {camera.model}: {", ".join(names)}'
        )


def judge(
    calibration: Calibration,
    prior: CameraGeometry,
    active: Calibration | None,
    options: GateOptions,
    estimation: CalibrationOptions,
) -> tuple[GateCheck, ...]:
    """
    The checks of the gate on a calibration, each with the value found and whether it passed.

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
        Only the first two where a parameter or a variance is not finite: all others use them.

    Raises
    ------
    ValueError
        When the calibration has no maps.
    """
    checks = (_solver(calibration), _numbers(calibration))
    if not checks[-1].passed:
        return checks
    return (
        *checks,
        *_fit(calibration, options, estimation),
        *_halves(calibration.halves, options),
        *_model(calibration.model_checks, options, estimation),
        *_precision(calibration, options),
        *_changes(calibration, prior, active, options),
    )


def reasons_of(checks: Iterable[GateCheck]) -> tuple[str, ...]:
    """A sentence for each check that failed; empty where none did."""
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


def _check(
    options: GateOptions | CalibrationOptions,
    option: str,
    name: str,
    found: float | str,
    unit: str = '',
) -> GateCheck:
    """A value, or the reason why there is none, against the limit of an option."""
    limit = float(getattr(options, option))
    if isinstance(found, str):
        return GateCheck(name, option, math.nan, limit, unit, None, found)
    # The condition is the one that must hold, so that NaN fails: a comparison with it is false.
    passed = found >= limit if option.startswith('min_') else found <= limit
    return GateCheck(name, option, float(found), limit, unit, bool(passed))


def _solver(calibration: Calibration) -> GateCheck:
    passed = calibration.termination == 'converged'
    note = '' if passed else f'the solver did not converge ({calibration.termination})'
    return GateCheck('solver converged', '', math.nan, math.nan, '', passed, note)


def _numbers(calibration: Calibration) -> GateCheck:
    values = np.concatenate(
        [
            calibration.geometry.camera.parameters,
            calibration.geometry.star_tracker_from_camera_xyzw,
            calibration.covariance.ravel(),
        ]
    )
    note = ''
    if not np.isfinite(values).all():
        note = 'a parameter or its covariance is not a finite number'
    elif (np.diag(calibration.covariance) < 0).any():
        note = 'a variance is negative'
    name = 'numbers finite, variances positive'
    return GateCheck(name, '', math.nan, math.nan, '', not note, note)


def _fit(
    calibration: Calibration, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Residuals, outliers, and the number of images and stars that fit."""
    stars = max(calibration.stars_used + calibration.stars_rejected, 1)
    images, misfits = calibration.images_used, len(calibration.misfit_images_ns)
    assumed_arcsec = np.array(estimation.star_tracker_sigma_arcsec)
    estimated_arcsec = np.array(calibration.star_tracker_sigma_arcsec)
    yield _check(
        options, 'max_residual_rms_px', 'residual per axis', calibration.residual_rms_px, 'px'
    )
    yield _check(
        options,
        'max_rejected_fraction',
        'fraction of stars left out as outliers',
        calibration.stars_rejected / stars,
    )
    yield _check(
        options,
        'max_misfit_fraction',
        'fraction of images whose attitude does not fit',
        misfits / max(images, 1),
    )
    yield _check(estimation, 'min_images', 'number of images that fit', images - misfits)
    yield _check(estimation, 'min_stars', 'number of stars that fit', calibration.stars_used)
    yield _check(
        options,
        'max_star_tracker_excess',
        'largest ratio of estimated to assumed star-tracker sigma',
        float((estimated_arcsec / assumed_arcsec).max())
        if assumed_arcsec.all()
        else 'star_tracker_sigma_arcsec is not given',
    )


def _halves(halves: HalvesComparison | None, options: GateOptions) -> Iterator[GateCheck]:
    """Agreement of the calibrations of the earlier and of the later images."""
    halves = halves or HalvesComparison(note='not recorded')
    for name, parameter, found, unit, p_value in (
        (
            'change of the distortion map between the halves of the images',
            'max_halves_px',
            halves.shape_px,
            'px',
            halves.shape_p_value,
        ),
        (
            'rotation between the halves of the images',
            'max_halves_rotation_arcsec',
            halves.rotation_arcsec,
            'arcsec',
            halves.p_value,
        ),
    ):
        check = _check(options, parameter, name, halves.note or found, unit)
        if check.passed is None:
            yield check
            continue
        likely = p_value >= options.min_halves_p_value
        note = (
            f'the p-value is {p_value:.1g}, {"at least" if likely else "under"} '
            f'{options.min_halves_p_value:g} (min_halves_p_value)'
        )
        yield dataclasses.replace(check, passed=check.passed or likely, note=note)


def _model(
    found: ModelChecks | None, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Contradictions between the stars and the assumed model, each with the remedy."""
    if found is None:
        return
    check = _check(
        estimation,
        'min_images',
        'number of independent pointings',
        round(found.independent_pointings, 2),
    )
    note = '' if check.passed else 'images of one pointing repeat their errors: collect others'
    yield dataclasses.replace(check, note=note)
    missing = found.field_rms_px == 0.0 and found.field_p_value < estimation.max_field_p_value
    check = _check(
        options,
        'max_field_px',
        'largest field beside the lens model',
        math.inf if missing else found.field_worst_px,
        'px',
    )
    remedy = 'the lens model does not describe the lens: set residual_field, or another lens_model'
    note = f'the p-value of none is {found.field_p_value:.1g}'
    yield dataclasses.replace(check, note=note if check.passed else f'{note}; {remedy}')
    for term in found.held:
        check = _check(
            options,
            'max_held_term_sigma',
            f'distance of {term.name} from its assumed value',
            term.significance,
            'sigma',
        )
        note = f'the stars put {term.name} at {term.asked:.6g}, assumed is {term.assumed:.6g}'
        if not check.passed:
            note += f': estimate {term.name}, or widen its prior (estimate, prior_sigma)'
        yield dataclasses.replace(check, note=note)
    step = found.step
    yield _significant(
        options,
        'max_detector_step_px',
        f'step of the detector in {step.moved} at {step.across} = {step.place_px:.0f}',
        abs(step.size_px),
        'px',
        step.p_value,
        'columns or rows are lost or shifted there: check the read-out',
    )
    name = 'velocity of the observer that the aberration misses'
    if found.velocity_sigma_km_s > options.max_velocity_error_km_s:
        note = f'the stars determine it to {found.velocity_sigma_km_s:.3g} km/s only'
        yield _check(options, 'max_velocity_error_km_s', name, note, 'km/s')
    else:
        yield _significant(
            options,
            'max_velocity_error_km_s',
            name,
            found.velocity_error_km_s,
            'km/s',
            found.velocity_p_value,
            'the velocity or the clock is wrong, or air bends the light: check the velocity'
            ' topic, the stamps and the site',
        )
    yield _significant(
        options,
        'max_image_variation_px',
        'change of the camera from image to image in a corner',
        found.image_variation_px,
        'px',
        found.image_variation_p_value,
        'focal length or lens changes between images: estimate with temperature, or calibrate '
        'each state apart',
    )
    check = _check(
        options,
        'min_independent_images',
        'images with independent star-tracker errors',
        found.independent_images,
    )
    note = ''
    if found.correlation_time_s > 0:
        note = (
            f'the errors are correlated over {found.correlation_time_s:.3g} s: collect images '
            'over a longer time'
        )
    yield dataclasses.replace(check, note=note)


def _significant(
    options: GateOptions,
    option: str,
    name: str,
    found: float,
    unit: str,
    p_value: float,
    remedy: str,
) -> GateCheck:
    """A check that fails where the value exceeds its limit and noise does not explain it."""
    check = _check(options, option, name, found, unit)
    likely = not p_value < options.min_model_p_value
    note = f'the p-value is {p_value:.1g}'
    if not check.passed and not likely:
        note += f'; {remedy}'
    return dataclasses.replace(check, passed=bool(check.passed) or likely, note=note)


def _precision(calibration: Calibration, options: GateOptions) -> Iterator[GateCheck]:
    """Coverage of the detector and precision of the result."""
    maps = calibration.maps
    if maps is None:
        raise ValueError('calibration: the gate needs its detector maps')
    yield _check(
        options,
        'min_coverage',
        'fraction of the detector with stars that fit',
        float((maps.stars > 0).mean()),
    )
    yield _check(
        options,
        'max_map_sigma_px',
        'largest 1-sigma of the distortion map',
        _map_sigma_px(calibration),
        'px',
    )
    check = _check(
        options,
        'max_line_of_sight_sigma_arcsec',
        'largest 1-sigma of a line of sight',
        float(maps.line_of_sight_sigma_arcsec.max()),
        'arcsec',
    )
    model = calibration.model_checks
    if model is not None and model.correlation_time_s > 0:
        note = f'star-tracker errors are correlated over {model.correlation_time_s:.3g} s'
        check = dataclasses.replace(check, note=note)
    yield check
    names = calibration.parameter_names
    limits = np.broadcast_to(options.max_parameter_sigma, len(names)).tolist()
    intrinsic, angles = 5, len(calibration.geometry.camera.parameters)
    for k, (name, sigma, limit) in enumerate(zip(names, calibration.sigma, limits, strict=True)):
        if limit > 0:
            unit = 'px' if k < intrinsic else '' if k < angles else 'arcsec'
            found = float(sigma) / (ARCSECOND_RAD if unit == 'arcsec' else 1.0)
            yield GateCheck(
                f'1-sigma of {name}',
                'max_parameter_sigma',
                found,
                limit,
                unit,
                found <= limit,
            )
    yield _check(
        options,
        'min_singular_value',
        'smallest singular value',
        calibration.singular_values[-1],
    )


def _map_sigma_px(calibration: Calibration) -> float:
    """Largest 1-sigma of the distortion map; NaN where a pixel has no line of sight."""
    try:
        return float(map_sigma_px(calibration.geometry.camera, calibration.joint_covariance).max())
    except np.linalg.LinAlgError:
        return math.nan


def _changes(
    calibration: Calibration,
    prior: CameraGeometry,
    active: Calibration | None,
    options: GateOptions,
) -> Iterator[GateCheck]:
    """Changes against the prior and against the active calibration."""
    yield _check(
        options,
        'max_zero_skew_cost_px',
        'largest error of camera_info, which has no skew',
        calibration.zero_skew_cost_px,
        'px',
    )
    rotation_rad, left_px = movement(prior, calibration.geometry)
    step = _step(active, calibration)
    no_limit = '' if options.max_step_sigma > 0 else 'no limit is set'
    of_map, of_sight = 'change of the distortion map', 'rotation of the lines of sight'
    for parameter, name, found, unit in (
        ('max_change_px', f'largest {of_map} from the prior', left_px.max(), 'px'),
        ('max_rotation_deg', f'{of_sight} from the prior', math.degrees(rotation_rad), 'deg'),
        (
            'max_step_px',
            f'largest {of_map} from the active calibration',
            step if isinstance(step, str) else step.shape_px,
            'px',
        ),
        (
            'max_step_rotation_deg',
            f'{of_sight} from the active calibration',
            step if isinstance(step, str) else math.degrees(step.rotation_rad),
            'deg',
        ),
        (
            'max_step_sigma',
            'change of the estimated parameters from the active calibration',
            no_limit or (step if isinstance(step, str) else step.total.rms_sigma),
            'sigma',
        ),
    ):
        check = _check(options, parameter, name, found, unit)
        if parameter == 'max_change_px' and check.passed is False:
            note = 'the prior camera or its lens model is not of this lens (lens_model)'
            check = dataclasses.replace(check, note=note)
        yield check


def _step(active: Calibration | None, calibration: Calibration) -> Difference | str:
    """Difference from the active calibration over the parameters that both estimate."""
    if active is None:
        return 'no calibration was active'
    if active.geometry.camera.model != calibration.geometry.camera.model:
        return f'the active calibration has the lens model {active.geometry.camera.model}'
    return difference(
        active.geometry,
        active.covariance,
        calibration.geometry,
        calibration.covariance,
        tuple(name for name in calibration.estimated if name in active.estimated),
    )
