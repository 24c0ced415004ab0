"""The gate: what a candidate calibration is held against, and every reason to refuse it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.assessment.agreement import Difference, movement
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import CalibrationOptions
from starcal_ros.options import option
from starcal_ros.records import calibration_parameter_names, CameraGeometry, GateCheck


@dataclass(frozen=True)
class GateOptions:
    """Limits that a calibration must keep to come into force."""

    max_residual_rms_px: float = option(
        1.0, 'largest residual per axis over the stars used, px', low=0.0, high=100.0
    )
    max_rejected_fraction: float = option(
        0.25, 'largest fraction of stars left out as outliers', low=0.0, high=1.0
    )
    min_coverage: float = option(
        0.3,
        'least fraction of the focal-plane cells that hold a star that fits',
        low=0.0,
        high=1.0,
    )
    max_map_sigma_px: float = option(
        0.5,
        'largest 1-sigma of the distortion map over the detector, common turn removed, px',
        low=0.0,
        high=100.0,
    )
    max_change_px: float = option(
        50.0,
        'largest change of the distortion map against the prior, common turn removed, px',
        low=0.0,
        high=1e5,
    )
    max_turn_deg: float = option(
        2.0,
        'largest turn of the lines of sight in the star tracker frame against the prior, degrees',
        low=0.0,
        high=180.0,
    )
    max_misfit_fraction: float = option(
        0.3, 'largest fraction of images whose attitude does not fit the others', low=0.0, high=1.0
    )
    max_star_tracker_excess: float = option(
        10.0,
        'largest 1-sigma of the star tracker found, over the one given, about any axis',
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
        " of the alignment about the camera's x, y, z (arcsec); 0: no limit, a single 0: none at"
        ' all',
        low=0.0,
    )
    min_singular_value: float = option(
        1e-4,
        'least singular value of the information, scaled to a unit diagonal: under it what is'
        ' estimated cannot be told apart',
        low=0.0,
        high=1.0,
    )
    max_zero_skew_cost_px: float = option(
        5.0, 'largest error of the camera without skew in camera_info, px', low=0.0, high=1e5
    )
    max_halves_px: float = option(
        1.0,
        'largest difference of the distortion maps of the earlier and the later half of the'
        ' images, common turn removed, where chance does not explain it, px',
        low=0.0,
        high=1e5,
    )
    max_halves_turn_arcsec: float = option(
        120.0,
        'largest turn between the two halves where chance does not explain it, arcsec',
        low=0.0,
        high=648000.0,
    )
    min_halves_chance: float = option(
        1e-4,
        'chance under which the halves are taken to differ: how often the gate refuses two halves'
        ' of one camera for either; 0: they are not compared',
        low=0.0,
        high=1.0,
    )
    max_step_px: float = option(
        10.0,
        'largest change of the distortion map against the calibration in force, common turn'
        ' removed, px',
        low=0.0,
        high=1e5,
    )
    max_step_turn_deg: float = option(
        0.5,
        'largest turn of the lines of sight against the calibration in force, degrees',
        low=0.0,
        high=180.0,
    )
    max_step_sigma: float = option(
        0.0,
        'largest change against the calibration in force in the sigmas of both, RMS over what both'
        ' estimate; 0: no limit, as a change that can be seen is what one calibrates for',
        low=0.0,
        high=1e6,
    )


@dataclass(frozen=True)
class Candidate:
    """
    What the gate looks at: a solution and its statistics.

    Attributes
    ----------
    geometry, prior : CameraGeometry
    covariance : (p + 3, p + 3)
    residual_rms_px : float
    images_used, images_misfit : int
        Images of the ensemble, and those of them whose attitude does not fit.
    stars_used, stars_rejected : int
    coverage : (rows, cols)
        Star observations used in each cell of the focal plane.
    map_sigma_px, line_of_sight_sigma_arcsec : float
        Largest over the detector.
    singular_value : float
        The smallest, of the scaled information.
    zero_skew_cost_px : float
    star_tracker_excess : float
        Largest ratio of the sigma found to the one given.
    termination : str
    halves : Difference or str
        Of the earlier and the later half of the images, or why they were not compared.
    step : Difference or None
        From the calibration in force; None where there is none.
    """

    geometry: CameraGeometry
    prior: CameraGeometry
    covariance: NDArray[np.float64]
    residual_rms_px: float
    images_used: int
    images_misfit: int
    stars_used: int
    stars_rejected: int
    coverage: NDArray[np.int64]
    map_sigma_px: float
    line_of_sight_sigma_arcsec: float
    singular_value: float
    zero_skew_cost_px: float
    star_tracker_excess: float
    termination: str
    halves: Difference | str
    step: Difference | None = None


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
    candidate: Candidate, options: GateOptions, calibration: CalibrationOptions
) -> tuple[GateCheck, ...]:
    """
    What the gate looks at, each with what was found and whether it is kept.

    Where a number that all others are made of is not finite, the checks end with it.
    """
    checks = (_solver(candidate), _numbers(candidate))
    if not checks[-1].kept:
        return checks
    return (
        *checks,
        *_of_the_fit(candidate, options, calibration),
        *_of_the_halves(candidate, options),
        *_of_the_knowledge(candidate, options),
        *_of_the_change(candidate, options),
    )


def reasons_of(checks: Iterable[GateCheck]) -> tuple[str, ...]:
    """A sentence for each check that is not kept; empty where nothing speaks against it."""
    return tuple(_reason(check) for check in checks if check.kept is False)


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
    """What was found, or why it was not, against the limit of an option."""
    limit = float(getattr(options, option))
    if isinstance(found, str):
        return GateCheck(name, option, math.nan, limit, unit, None, found)
    # A limit is written as what must hold, so that NaN is refused: a comparison with it is false.
    kept = found >= limit if option.startswith('min_') else found <= limit
    return GateCheck(name, option, float(found), limit, unit, bool(kept))


def _solver(candidate: Candidate) -> GateCheck:
    kept = candidate.termination == 'converged'
    note = '' if kept else f'the solver did not converge ({candidate.termination})'
    return GateCheck('solver converged', '', math.nan, math.nan, '', kept, note)


def _numbers(candidate: Candidate) -> GateCheck:
    values = np.concatenate(
        [
            candidate.geometry.camera.parameters,
            candidate.geometry.star_tracker_from_camera_xyzw,
            candidate.covariance.ravel(),
        ]
    )
    note = ''
    if not np.isfinite(values).all():
        note = 'a parameter or its covariance is not a finite number'
    elif (np.diag(candidate.covariance) < 0).any():
        note = 'a variance is negative'
    name = 'numbers finite, variances positive'
    return GateCheck(name, '', math.nan, math.nan, '', not note, note)


def _of_the_fit(
    candidate: Candidate, options: GateOptions, calibration: CalibrationOptions
) -> Iterator[GateCheck]:
    """What does not fit, and whether enough does."""
    stars = max(candidate.stars_used + candidate.stars_rejected, 1)
    fitting = candidate.images_used - candidate.images_misfit
    yield _check(
        options, 'max_residual_rms_px', 'residual per axis', candidate.residual_rms_px, 'px'
    )
    yield _check(
        options,
        'max_rejected_fraction',
        'fraction of stars left out as outliers',
        candidate.stars_rejected / stars,
    )
    yield _check(
        options,
        'max_misfit_fraction',
        'fraction of images whose attitude does not fit',
        candidate.images_misfit / max(candidate.images_used, 1),
    )
    yield _check(calibration, 'min_images', 'number of images that fit', fitting)
    yield _check(calibration, 'min_stars', 'number of stars that fit', candidate.stars_used)
    yield _check(
        options,
        'max_star_tracker_excess',
        '1-sigma of the star tracker, found over given, at its worst',
        candidate.star_tracker_excess,
    )


def _of_the_halves(candidate: Candidate, options: GateOptions) -> Iterator[GateCheck]:
    """Whether the earlier and the later images show one camera, or differ by chance."""
    halves = candidate.halves
    for name, parameter, found, unit, chance in (
        (
            'change of the distortion map between the halves of the images',
            'max_halves_px',
            halves if isinstance(halves, str) else halves.shape_px,
            'px',
            math.nan if isinstance(halves, str) else halves.shape_chance,
        ),
        (
            'turn between the halves of the images',
            'max_halves_turn_arcsec',
            halves if isinstance(halves, str) else halves.turn_rad / ARCSECOND_RAD,
            'arcsec',
            math.nan if isinstance(halves, str) else halves.chance,
        ),
    ):
        check = _check(options, parameter, name, found, unit)
        if check.kept is None:
            yield check
            continue
        likely = chance >= options.min_halves_chance
        note = (
            f'the chance of as much is {chance:.1g}, {"at least" if likely else "under"} '
            f'{options.min_halves_chance:g} (min_halves_chance)'
        )
        yield dataclasses.replace(check, kept=check.kept or likely, note=note)


def _of_the_knowledge(candidate: Candidate, options: GateOptions) -> Iterator[GateCheck]:
    """What is known too little of."""
    yield _check(
        options,
        'min_coverage',
        'fraction of the detector with stars that fit',
        float((candidate.coverage > 0).mean()),
    )
    yield _check(
        options,
        'max_map_sigma_px',
        '1-sigma of the distortion map at its worst',
        candidate.map_sigma_px,
        'px',
    )
    yield _check(
        options,
        'max_line_of_sight_sigma_arcsec',
        '1-sigma of a line of sight at its worst',
        candidate.line_of_sight_sigma_arcsec,
        'arcsec',
    )
    sigma = np.sqrt(np.diag(candidate.covariance))
    sigma[-3:] /= ARCSECOND_RAD
    units = ('px',) * 5 + ('',) * (len(sigma) - 8) + ('arcsec',) * 3
    names = calibration_parameter_names(candidate.geometry.camera)
    limits = np.broadcast_to(options.max_parameter_sigma, len(names)).tolist()
    for name, found, limit, unit in zip(names, sigma, limits, units, strict=True):
        if limit > 0:
            kept = bool(found <= limit)
            name = f'1-sigma of {name}'
            yield GateCheck(name, 'max_parameter_sigma', float(found), limit, unit, kept)
    yield _check(
        options,
        'min_singular_value',
        'smallest singular value',
        candidate.singular_value,
    )


def _of_the_change(candidate: Candidate, options: GateOptions) -> Iterator[GateCheck]:
    """What would change too much for whoever uses it."""
    yield _check(
        options,
        'max_zero_skew_cost_px',
        'error of camera_info, which has no skew, at its worst',
        candidate.zero_skew_cost_px,
        'px',
    )
    turn_rad, left_px = movement(candidate.prior, candidate.geometry)
    step = candidate.step
    none = 'no calibration was in force'
    no_limit = '' if options.max_step_sigma > 0 else 'no limit is set'
    of_map, of_sight = 'change of the distortion map', 'turn of the lines of sight'
    prior, before = 'from the prior', 'from the calibration in force'
    for parameter, name, found, unit in (
        ('max_change_px', f'{of_map} {prior} at its worst', left_px.max(), 'px'),
        ('max_turn_deg', f'{of_sight} {prior}', math.degrees(turn_rad), 'deg'),
        ('max_step_px', f'{of_map} {before} at its worst', step.shape_px if step else none, 'px'),
        (
            'max_step_turn_deg',
            f'{of_sight} {before}',
            math.degrees(step.turn_rad) if step else none,
            'deg',
        ),
        (
            'max_step_sigma',
            f'change of what is estimated {before}',
            no_limit or (step.rms_sigma if step else none),
            'sigma',
        ),
    ):
        yield _check(options, parameter, name, found, unit)
