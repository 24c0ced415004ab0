# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of the report on the assumptions of a calibration: what the stars show, and the remedy."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

from starcal_ros.records import Calibration, HeldTerm, ModelChecks


@dataclass(frozen=True)
class ModelRow:
    """An assumption, what the stars show of it, its p-value as text and the remedy if it fails."""

    assumption: str
    found: str
    p_value: str
    remedy: str


def model_rows(calibration: Calibration) -> list[ModelRow]:
    """Rows for the assumptions that a calibration tested; none of one that tested none."""
    found = calibration.model_checks
    if found is None:
        return []
    camera_info = (
        f'camera_info carries neither field nor skew: {_px(calibration.zero_skew_cost_px)}'
    )
    field = (
        f'field of {_px(found.field_rms_px)} rms per axis, at most {_px(found.field_worst_px)}'
        if found.field_rms_px > 0
        else 'no field needed'
    )
    if calibration.field is not None and found.field_rms_px == 0.0:
        field += (
            f'; one of {_px(calibration.field.amplitude_px)} is not excluded and is in the sigmas'
        )
    return [
        ModelRow(
            'The lens model describes the lens',
            f'{field}; {camera_info} at most',
            _p(found.field_p_value),
            'estimate the field (residual_field) or choose another lens_model; for lines of sight'
            ' with the field use starcal lookup',
        ),
        *(_held(term) for term in found.held),
        *_detector_and_sky(found),
        *_images(found, calibration.images_used),
    ]


def _held(term: HeldTerm) -> ModelRow:
    return ModelRow(
        f'{term.name} is {term.assumed:.6g}',
        f'the stars put it at {term.asked:.6g}, {term.significance:.1f} sigma from it',
        _p(math.erfc(term.significance / math.sqrt(2))),
        f'estimate {term.name} (estimate) or widen its prior (prior_sigma)',
    )


def _detector_and_sky(found: ModelChecks) -> Iterator[ModelRow]:
    step = found.step
    yield ModelRow(
        'The detector has no step',
        f'{_px(abs(step.size_px))} in {step.moved} at {step.across} = {step.place_px:.0f}',
        _p(step.p_value),
        'columns or rows are lost or shifted there: check the read-out',
    )
    yield ModelRow(
        "The observer's velocity is right",
        f'misses {found.velocity_error_km_s:.3g} km/s; 1-sigma {found.velocity_sigma_km_s:.3g}'
        ' km/s',
        _p(found.velocity_p_value),
        'check the velocity topic, the stamps and the site',
    )


def _images(found: ModelChecks, images: int) -> Iterator[ModelRow]:
    yield ModelRow(
        'The camera is the same in all images',
        f'varies by {_px(found.image_variation_px)} in a corner',
        _p(found.image_variation_p_value),
        'estimate with temperature, or calibrate each state apart',
    )
    if found.correlation_time_s > 0:
        correlated = f'correlated over {found.correlation_time_s:.3g} s: '
    else:
        correlated = ''
    yield ModelRow(
        'Star-tracker errors are independent',
        f'{correlated}{found.independent_images:.3g} independent of {images} images',
        '',
        'collect images over a longer time',
    )
    yield ModelRow(
        'Each image adds stars on other pixels',
        f'{found.pointings} pointings; worth {found.independent_pointings:.3g} of {images} images',
        '',
        'collect images of other fields',
    )


def _px(value: float) -> str:
    return f'{value:.3g} px'


def _p(value: float) -> str:
    """A p-value as text; empty where nothing was tested."""
    if math.isnan(value):
        return ''
    return '< 1e\N{MINUS SIGN}6' if value < 1e-6 else f'{value:.2g}'
