# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Where the data contradict the model of a calibration.

What is unknown is estimated with a prior; here is what goes beyond it: unknowns far from their
priors, amplitudes with their likelihood ratios, a step of the detector, and the predictions of
what was left out.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import math

import numpy as np
from scipy.special import ndtr

from starcal_ros.arrays import Floats, Mask
from starcal_ros.assessment.gate import GateOptions
from starcal_ros.assessment.lookup import GRID
from starcal_ros.assessment.predictions import predictions
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.amplitudes import LogPrior
from starcal_ros.estimation.calibrate import Estimate, LENS_RESIDUAL_LOG_SIGMA
from starcal_ros.estimation.limits import FREE_FACTOR
from starcal_ros.estimation.options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.estimation.posterior import without_prior
from starcal_ros.estimation.shared_errors import coarsest_cell_px
from starcal_ros.estimation.tracker_errors import STATED_NOISE, STATED_SLOW
from starcal_ros.estimation.unknowns import CHANGE, Layout, Unknown
from starcal_ros.records import Amplitude, DetectorStep, HeldTerm, ModelChecks, StatementCheck
from starcal_ros.text import significant

_STEPS = 5  # places in the width of a strip: a step between two loses a tenth of its size
_MARGIN = 0.1  # ends of a side, as a share of it: lenses leave 0.25 px there that look like steps


def model_checks(estimate: Estimate, statements: tuple[StatementCheck, ...] = ()) -> ModelChecks:
    """Return what the stars of an estimate show of the model that it assumes, and statements."""
    camera = estimate.geometry.camera
    rms_px, worst_px = _field_px(camera)
    return ModelChecks(
        amplitudes=_amplitudes(estimate),
        field_rms_px=rms_px,
        field_worst_px=worst_px,
        held=_held_terms(estimate),
        step=detector_step(estimate),
        image_variation_px=_image_variation_px(estimate),
        predictions=predictions(estimate),
        statements=statements,
    )


def check_sigmas(estimate: Estimate, options: CalibrationOptions) -> tuple[StatementCheck, ...]:
    """
    Return the stated sigmas that their estimates contradict, by the prior of the estimate.

    The calibration holds without them, so nothing is refused for them.
    """
    trackers = [] if options.method == 'single' else estimate.attitudes.trackers
    noise = [(t.sigma_rad / ARCSECOND_RAD, t.noise) for t in trackers]
    slow = options.star_tracker_slow_arcsec
    lens, lens_px = options.lens_residual_px, math.exp(estimate.posterior.field.log_px[0])
    sigmas = [
        *[
            ('star_tracker_sigma_arcsec', '″', STATED_NOISE, stated, stated * times)
            for stated, times in noise * tracker_sigma_is_given(options)
        ],
        *[
            ('star_tracker_slow_arcsec', '″', STATED_SLOW, slow, t.slow * sigma)
            for t, (sigma, _) in zip(trackers, noise, strict=True)
        ],
        ('lens_residual_px', ' px', LogPrior(0.0, LENS_RESIDUAL_LOG_SIGMA), lens, lens_px),
    ]
    checks = {
        name: f'{significant(stated, 3)}{unit} stated, {significant(found, 3)}{unit} by the images'
        ' and so in the sigmas; correct the option, or look for what else moves the images'
        for name, unit, prior, stated, found in sigmas
        if stated and prior.is_wrong(np.log(found / stated))
    }
    return tuple(StatementCheck(name, None, note) for name, note in checks.items())


def _amplitudes(estimate: Estimate) -> tuple[Amplitude, ...]:
    """
    Return the estimated amplitudes, each with twice its log likelihood against none.

    Those of the field, its term and the shapes are at their maximum: the budget has the size of
    what is estimated with them, with its uncertainty.
    """
    found, parts = estimate.posterior, len({t.axes for t in estimate.attitudes.trackers})
    octaves = float(np.sqrt((np.exp(found.field.log_px) ** 2).sum()))
    shape = float(np.sqrt((np.exp(found.shapes.amplitudes.log_px) ** 2).sum()))
    term = float(np.exp(found.term.log_px[0]))
    most_likely = (
        ('field', octaves, found.field),
        ('next term of the lens', term, found.term),
        (CHANGE, shape, found.shapes.amplitudes),
    )
    return (
        *(
            Amplitude(f'{name}, most likely amplitude', size_px, 'px', one.likelihood_ratio)
            for name, size_px, one in most_likely
        ),
        *(
            Amplitude(error.name, math.sqrt(error.variance_px2), 'px', error.likelihood_ratio)
            for error in estimate.weights.errors
        ),
        *(
            Amplitude(
                f'slow error of star tracker {k // parts + 1} about'
                f' {", ".join("xyz"[axis] for axis in one.axes)}, {one.correlation}',
                one.slow,
                'sigma',
                one.likelihood_ratio,
            )
            for k, one in enumerate(estimate.attitudes.trackers)
        ),
    )


def _image_variation_px(estimate: Estimate) -> float:
    """1-sigma change of the camera from image to image in a corner, px."""
    camera = estimate.geometry.camera
    corner_px = 0.5 * math.hypot(camera.width, camera.height)
    trend_px = estimate.posterior.mean[estimate.linear.layout.trend_at]
    sigma_px = np.append(trend_px, np.exp(estimate.posterior.shapes.amplitudes.log_px))
    # Those of the focal length grow to the corner; the decentring is that of the corner.
    sigma_px[: len(trend_px) + 3] *= corner_px / float(camera.parameters[0])
    return float(np.linalg.norm(sigma_px))


def _field_px(camera: CameraModel) -> tuple[float, float]:
    """RMS per axis and largest length of the field over the detector, px."""
    if camera.field is None:
        return 0.0, 0.0
    moved = camera.field.displacement_px(pixel_grid(camera, GRID, GRID))
    return float(np.sqrt((moved**2).mean())), float(np.linalg.norm(moved, axis=1).max())


def _held_terms(estimate: Estimate) -> tuple[HeldTerm, ...]:
    """
    Return unknowns that are held or have a stated prior, with what the stars ask for.

    Each prior is tested by estimating again without it, a held parameter by estimating it: the
    field and the shapes of the images absorb the conflict, the unknown itself hardly moves.  Free
    unknowns also fit errors of the lens: a distance that fails the gate counts where the data are
    as much likelier without the prior, and otherwise as much as they are.  What the stars alone do
    not determine is listed too, with NaN.
    """
    clear_sigma = GateOptions.max_held_term_sigma
    found, linear = estimate.posterior, estimate.linear
    layout, prior_camera = linear.layout, linear.problem.prior_parameters
    total, working = np.diag(found.covariance), np.diag(found.working)
    mountings = {
        f'star_tracker_{k}_{axis}': (f'mounting of {one.frame} {axis}_deg', math.degrees(1.0))
        for k, one in enumerate(estimate.star_trackers, 1)
        for axis in 'xyz'
    }
    terms = []
    for entry, freed, tested in _without_priors(layout):
        assert entry.kind.tested is not None
        means, variances, log_evidence = without_prior(estimate.sums, linear, freed, found)
        gained = log_evidence - found.log_evidence
        for own in np.flatnonzero(tested):
            k = layout.places[entry.name].start + own
            shown = float(variances[own]) if math.isfinite(variances[own]) else math.nan
            off = float(layout.prior_offset[k] + means[own]) + 0.0 * shown
            is_held = entry.sigma[own] == 0
            # Errors that observations share are in both variances.
            by_stars2 = shown if is_held else shown * total[k] / working[k]
            sigma = math.sqrt(min(entry.sigma[own], entry.plausible_sigma) ** 2 + by_stars2)
            is_far = math.isinf(entry.plausible_sigma) and abs(off) > clear_sigma * sigma
            is_decided = is_held or gained > 0.5 * clear_sigma**2
            evidence = gained if is_far and not is_decided else math.nan
            # What is not in the state is zero there, so far from its prior mean.
            prior = 0.0 if entry.turn is None else 0.0 - float(layout.prior_offset[k])
            if entry.name == 'camera':
                prior = float(prior_camera[own])
            label = layout.labels[k]
            name, unit = {**mountings, **entry.kind.tested.as_stated}.get(label, (label, 1.0))
            terms.append(HeldTerm(name, prior, prior + unit * off, unit * sigma, evidence))
    return tuple(terms)


def _without_priors(layout: Layout) -> Iterator[tuple[Unknown, Unknown, Mask]]:
    """
    Yield entries, the same with one of their numbers free or all, and which of these it tests.

    A number that is held is free alone, those with a prior all together.
    """
    for entry in layout.shared:
        if entry.kind.tested is None:
            continue
        is_held = entry.sigma == 0
        for alone in np.eye(len(entry), dtype=bool)[is_held]:
            yield (
                entry,
                dataclasses.replace(entry, sigma=np.where(alone, np.inf, entry.sigma)),
                alone,
            )
        widest = np.minimum(FREE_FACTOR * entry.sigma, entry.widest)
        # Nobody states a prior as wide as any lens needs.
        tested = ~is_held & np.isfinite(entry.sigma) & (entry.widest > entry.sigma)
        if tested.any():
            sigma = np.maximum(entry.sigma, widest)
            yield entry, dataclasses.replace(entry, sigma=sigma), tested


def detector_step(estimate: Estimate) -> DetectorStep:
    """
    Return the most significant step between two parts of the detector.

    It is the difference of the mean residuals of two strips side by side, so narrow that no wave
    of the field takes a part of it.
    """
    kept = estimate.kept
    camera = estimate.geometry.camera
    strip_px = coarsest_cell_px(camera.width)
    residual_px = estimate.residual_px[kept]
    weight = 1.0 / estimate.weights.variance_px2[kept]
    best, best_significance, trials = ('u', 0.0, 'u', 0.0), 0.0, 0
    for axis, size in enumerate((camera.width, camera.height)):
        inner_px = (1.0 - 2.0 * _MARGIN) * size
        count = round(_STEPS * inner_px / strip_px) + 1
        place_px = np.asarray(_MARGIN * size - 0.5 + np.linspace(0.0, inner_px, count), np.float64)
        trials += 2 * round(inner_px / strip_px)  # two axes of the residual at places apart
        pixels = estimate.table.measured_px[kept, axis]
        before, variance_before = _means(
            pixels, residual_px, weight, place_px - strip_px, place_px
        )
        after, variance_after = _means(pixels, residual_px, weight, place_px, place_px + strip_px)
        step, sigma = after - before, np.sqrt(variance_before + variance_after)[:, None]
        significance = np.abs(step) / sigma
        k, moved = np.unravel_index(int(np.argmax(significance)), significance.shape)
        if significance[k, moved] > best_significance:
            best_significance = float(significance[k, moved])
            best = ('uv'[axis], float(place_px[k]), 'uv'[moved], float(step[k, moved]))
    p_value = min(1.0, 2.0 * trials * float(ndtr(-best_significance)))
    return DetectorStep(*best, p_value)


def _means(
    pixels: Floats, residual_px: Floats, weight: Floats, low_px: Floats, high_px: Floats
) -> tuple[Floats, Floats]:
    """Weighted means (k, 2) of residuals between pixels (k,) and (k,), and their variances."""
    order = np.argsort(pixels)
    ends = np.searchsorted(pixels[order], np.stack([low_px, high_px]))
    columns = np.column_stack([weight, weight[:, None] * residual_px])[order]
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(columns, axis=0)])
    total = summed[ends[1]] - summed[ends[0]]
    with np.errstate(divide='ignore', invalid='ignore'):
        means = np.nan_to_num(total[:, 1:] / total[:, :1])
        return means, 1.0 / total[:, 0]
