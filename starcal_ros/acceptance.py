"""The gate: whether a candidate calibration may come into force, and if not, every reason."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.agreement import Difference, movement
from starcal_ros.calibration import CalibrationOptions
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.options import option
from starcal_ros.records import CALIBRATION_PARAMETER_NAMES, CameraGeometry


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
        0.3, 'least fraction of the focal-plane cells that hold a star', low=0.0, high=1.0
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
        (0.0,) * 13,
        'largest 1-sigma of fx, skew, fy, cx, cy (px), k1, k2, k3, p1, p2, and of the alignment'
        " about the camera's x, y, z (arcsec); 0: no limit",
        low=0.0,
        length=13,
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
    covariance : (13, 13)
    residual_rms_px : float
    images_used, images_misfit : int
        Images of the ensemble, and those of them whose attitude does not fit.
    stars_used, stars_rejected : int
    coverage : (rows, cols)
        Star observations in each cell of the focal plane.
    map_sigma_px, line_of_sight_sigma_arcsec : float
        Largest over the detector.
    singular_value : float
        The smallest, of the scaled information.
    zero_skew_cost_px : float
    star_tracker_excess : float
        Largest ratio of the sigma found to the one given.
    termination : str
    halves : Difference or None
        Of the earlier and the later half of the images; None where they could not be compared.
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
    halves: Difference | None = None
    step: Difference | None = None


def judge(
    candidate: Candidate, options: GateOptions, calibration: CalibrationOptions
) -> tuple[str, ...]:
    """
    Every reason against a candidate, one sentence each; empty when it may come into force.

    A limit is written as what must hold, so that NaN is refused: a comparison with it is false.
    """
    reasons = []
    if candidate.termination != 'converged':
        reasons.append(f'the solver did not converge ({candidate.termination})')
    values = np.concatenate(
        [
            candidate.geometry.camera.parameters,
            candidate.geometry.star_tracker_from_camera_xyzw,
            candidate.covariance.ravel(),
        ]
    )
    if not np.isfinite(values).all():
        return (*reasons, 'a parameter or its covariance is not a finite number')
    if (np.diag(candidate.covariance) < 0).any():
        return (*reasons, 'a variance is negative')
    return (
        *reasons,
        *_against_the_fit(candidate, options, calibration),
        *_against_the_knowledge(candidate, options),
        *_against_the_change(candidate, options),
    )


def _against_the_fit(
    candidate: Candidate, options: GateOptions, calibration: CalibrationOptions
) -> Iterator[str]:
    """What does not fit, and whether enough does."""
    if not candidate.residual_rms_px <= options.max_residual_rms_px:
        yield (
            f'residual {candidate.residual_rms_px:.3f} px per axis is over the limit of '
            f'{options.max_residual_rms_px:g} px (max_residual_rms_px)'
        )
    total = candidate.stars_used + candidate.stars_rejected
    if not candidate.stars_rejected <= options.max_rejected_fraction * total:
        yield (
            f'{candidate.stars_rejected} of {total} stars are outliers, more than a fraction of '
            f'{options.max_rejected_fraction:g} (max_rejected_fraction)'
        )
    if not candidate.images_misfit <= options.max_misfit_fraction * candidate.images_used:
        yield (
            f'the attitudes of {candidate.images_misfit} of {candidate.images_used} images do not '
            f'fit, more than a fraction of {options.max_misfit_fraction:g} (max_misfit_fraction)'
        )
    fitting = candidate.images_used - candidate.images_misfit
    if not fitting >= calibration.min_images:
        yield (f'{fitting} images fit, under the limit of {calibration.min_images} (min_images)')
    if not candidate.stars_used >= calibration.min_stars:
        yield (
            f'{candidate.stars_used} stars fit, under the limit of {calibration.min_stars} '
            '(min_stars)'
        )
    if not candidate.star_tracker_excess <= options.max_star_tracker_excess:
        yield (
            f'the star tracker is {candidate.star_tracker_excess:.1f} times worse than given, '
            f'over the limit of {options.max_star_tracker_excess:g} (max_star_tracker_excess)'
        )
    halves = candidate.halves
    if halves is None:
        return
    turn_arcsec = halves.turn_rad / ARCSECOND_RAD
    for chance, value, limit, unit, what, name in (
        (halves.shape_chance, halves.shape_px, options.max_halves_px, 'px', 'differ', ''),
        (
            *(halves.chance, turn_arcsec, options.max_halves_turn_arcsec),
            *('arcsec', 'are turned', '_turn_arcsec'),
        ),
    ):
        if not chance >= options.min_halves_chance and not value <= limit:
            yield (
                f'the earlier and the later half of the images {what} by {value:.3g} {unit}, over '
                f'the limit of {limit:g} {unit} (max_halves{name or "_px"}); chance does it once '
                f'in {1 / max(chance, 1e-99):.0e} (min_halves_chance)'
            )


def _against_the_knowledge(candidate: Candidate, options: GateOptions) -> Iterator[str]:
    """What is known too little of."""
    covered = float((candidate.coverage > 0).mean())
    if not covered >= options.min_coverage:
        yield (
            f'stars cover {100 * covered:.0f} % of the detector, under the limit of '
            f'{100 * options.min_coverage:.0f} % (min_coverage)'
        )
    if not candidate.map_sigma_px <= options.max_map_sigma_px:
        yield (
            f'the distortion map is uncertain by {candidate.map_sigma_px:.3f} px at its worst, '
            f'over the limit of {options.max_map_sigma_px:g} px (max_map_sigma_px)'
        )
    if not candidate.line_of_sight_sigma_arcsec <= options.max_line_of_sight_sigma_arcsec:
        yield (
            f'a line of sight is uncertain by {candidate.line_of_sight_sigma_arcsec:.1f} arcsec '
            f'at its worst, over the limit of {options.max_line_of_sight_sigma_arcsec:g} arcsec '
            '(max_line_of_sight_sigma_arcsec)'
        )
    sigma = np.sqrt(np.diag(candidate.covariance))
    sigma[10:] /= ARCSECOND_RAD
    for name, value, limit in zip(
        CALIBRATION_PARAMETER_NAMES, sigma, options.max_parameter_sigma, strict=True
    ):
        if limit > 0 and not value <= limit:
            yield (
                f'{name} is uncertain by {value:.3g}, over the limit of {limit:g} '
                '(max_parameter_sigma)'
            )
    if not candidate.singular_value >= options.min_singular_value:
        yield (
            f'the smallest singular value is {candidate.singular_value:.1e}, under the limit of '
            f'{options.min_singular_value:g} (min_singular_value): what is estimated cannot be '
            'told apart'
        )


def _against_the_change(candidate: Candidate, options: GateOptions) -> Iterator[str]:
    """What would change too much for whoever uses it."""
    if not candidate.zero_skew_cost_px <= options.max_zero_skew_cost_px:
        yield (
            f'camera_info without skew is {candidate.zero_skew_cost_px:.2f} px off at its worst, '
            f'over the limit of {options.max_zero_skew_cost_px:g} px (max_zero_skew_cost_px)'
        )
    turn_rad, left_px = movement(candidate.prior, candidate.geometry)
    shape_px = left_px.max()
    if not shape_px <= options.max_change_px:
        yield (
            f'the distortion map would change by {shape_px:.1f} px at its worst, '
            f'over the limit of {options.max_change_px:g} px (max_change_px)'
        )
    if not np.degrees(turn_rad) <= options.max_turn_deg:
        yield (
            f'the lines of sight would turn by {np.degrees(turn_rad):.3f} degrees, '
            f'over the limit of {options.max_turn_deg:g} degrees (max_turn_deg)'
        )
    step = candidate.step
    if step is None:
        return
    if not step.shape_px <= options.max_step_px:
        yield (
            f'the distortion map would change by {step.shape_px:.2f} px against the calibration '
            f'in force, over the limit of {options.max_step_px:g} px (max_step_px)'
        )
    if not np.degrees(step.turn_rad) <= options.max_step_turn_deg:
        yield (
            f'the lines of sight would turn by {np.degrees(step.turn_rad):.3f} degrees against '
            f'the calibration in force, over the limit of {options.max_step_turn_deg:g} degrees '
            '(max_step_turn_deg)'
        )
    if options.max_step_sigma > 0 and not step.rms_sigma <= options.max_step_sigma:
        yield (
            f'what is estimated would change by {step.rms_sigma:.1f} sigma against the '
            f'calibration in force, over the limit of {options.max_step_sigma:g} (max_step_sigma)'
        )
