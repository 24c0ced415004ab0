# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Gate checks of the model that a calibration assumes."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import math

from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.gate.options import GateOptions, limit_check
from starcal_ros.records import GateCheck, ModelChecks, ResidualBin, StarTrackerAlignment

_DRIFT_P_VALUE = 1e-4  # of a star tracker; a few images determine a slope to no more
_PART_TOLERANCE = 0.05  # of a normalised residual, within which a part of the data is as predicted
_PART_SIGMAS = 3.5  # one of twelve parts exceeds it by noise in 1 of 200 calibrations


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
                'that star tracker or its mounting moves: leave it out of more_star_trackers, or'
                ' collect images over a shorter time',
                _DRIFT_P_VALUE,
            )


def model_gate(
    found: ModelChecks | None, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Contradictions between the stars and the assumed model, each with the remedy."""
    if found is None:
        return
    yield from _lens(found, options, estimation)
    yield from _read_out_and_light(found, options)
    yield from _cross_validated(found.cross_validation, options)
    check = limit_check(
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


def _lens(
    found: ModelChecks, options: GateOptions, estimation: CalibrationOptions
) -> Iterator[GateCheck]:
    """Pointings that show the lens, what its model leaves, and terms that are held."""
    check = limit_check(
        estimation,
        'min_images',
        'number of independent pointings',
        round(found.independent_pointings, 2),
    )
    note = '' if check.passed else 'images of one pointing repeat their errors: collect others'
    yield dataclasses.replace(check, note=note)
    missing = found.field_rms_px == 0.0 and found.field_p_value < estimation.max_field_p_value
    check = limit_check(
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
        check = limit_check(
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


def _read_out_and_light(found: ModelChecks, options: GateOptions) -> Iterator[GateCheck]:
    """Steps of the detector, aberration, and change from image to image."""
    step = found.step
    yield _significant(
        options,
        'max_detector_step_px',
        f'step of the detector in {step.moved} at {step.across} = {step.place_px:.0f}',
        abs(step.size_px),
        'px',
        step.p_value,
        'columns or rows are lost or shifted there: check the read-out',
        options.min_model_p_value,
    )
    name = 'velocity of the observer that the aberration misses'
    if found.velocity_sigma_km_s > options.max_velocity_error_km_s:
        note = f'the stars determine it to {found.velocity_sigma_km_s:.3g} km/s only'
        yield limit_check(options, 'max_velocity_error_km_s', name, note, 'km/s')
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
            options.min_model_p_value,
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
        options.min_model_p_value,
    )


def _cross_validated(bins: tuple[ResidualBin, ...], options: GateOptions) -> Iterator[GateCheck]:
    """The part of the data whose residuals exceed their predicted sigma the most."""
    if not bins:
        return

    def excess(part: ResidualBin) -> float:
        # No part fails for the noise of its few stars.
        return part.normalised - _PART_SIGMAS * part.sigma

    worst = max(bins, key=excess)
    doubtful = [
        f'{part.by} {part.low:.4g} to {part.high:.4g}: {part.normalised:.3f}'
        for part in bins
        if abs(part.normalised - 1.0) > max(_PART_TOLERANCE, _PART_SIGMAS * part.sigma)
    ]
    check = limit_check(
        options,
        'max_cross_validated_residual',
        f'residual over predicted sigma at {worst.by} {worst.low:.4g} to {worst.high:.4g}',
        worst.normalised,
    )
    passed = bool(check.passed) or excess(worst) <= options.max_cross_validated_residual
    note = f'not within {_PART_TOLERANCE:.0%} of 1: {", ".join(doubtful)}' if doubtful else ''
    if not passed:
        note += '; the sigma does not hold there: look at the PSF, the lens model or those images'
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
    """A check that fails where the value exceeds its limit and noise does not explain it."""
    check = limit_check(options, option, name, found, unit)
    likely = not p_value < least_p_value
    note = f'the p-value is {p_value:.1g}'
    if not check.passed and not likely:
        note += f'; {remedy}'
    return dataclasses.replace(check, passed=bool(check.passed) or likely, note=note)
