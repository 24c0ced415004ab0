# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Gate checks of the model that a calibration assumes."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import math

from starcal_ros.gate.options import GateOptions, limit_check
from starcal_ros.records import GateCheck, ModelChecks, ResidualBin, StarTrackerAlignment

_DRIFT_P_VALUE = 1e-4  # of a star tracker; a few images determine a slope to no more
_STEP_P_VALUE = 1e-6  # of a step of the detector among all places
# What to do where the stars contradict what is assumed of an unknown, by the start of its label.
_REMEDIES = {
    'velocity': 'the velocity or the clock is wrong, or air bends the light: check the velocity'
    ' topic, the stamps and the site',
    'readout': 'check shutter and readout_s',
    'stamp': 'check stamp_offset_s and the clocks of camera and star tracker',
    'mounting': 'check more_alignments, or widen star_tracker_mounting_sigma_arcsec',
}
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


def model_gate(found: ModelChecks | None, options: GateOptions) -> Iterator[GateCheck]:
    """Contradictions between the stars and the model with its priors, each with the remedy."""
    if found is None:
        return
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
            note += '; ' + _REMEDIES.get(
                term.name.replace(' ', '_').partition('_')[0],
                f'estimate {term.name}, or widen its prior (estimate, prior_sigma)',
            )
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
        _STEP_P_VALUE,
    )
    check = limit_check(
        options,
        'max_image_variation_px',
        'change of the camera from image to image in a corner',
        found.image_variation_px,
        'px',
    )
    if not check.passed:
        note = (
            'focal length or lens changes between images: estimate with temperature, or calibrate'
            ' each state by itself'
        )
        check = dataclasses.replace(check, note=note)
    yield check
    yield from _predicted(found.predictions, options)


def _predicted(bins: tuple[ResidualBin, ...], options: GateOptions) -> Iterator[GateCheck]:
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
