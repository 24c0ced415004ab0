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
    field = f'field of {_px(found.field_rms_px)} rms per axis, at most {_px(found.field_worst_px)}'
    return [
        ModelRow(
            'The lens model describes the lens',
            f'{field}; {camera_info} at most',
            '',
            'choose another lens_model; for lines of sight with the field use starcal lookup',
        ),
        *(_held(term) for term in found.held),
        *_detector_and_images(found),
    ]


def _held(term: HeldTerm) -> ModelRow:
    return ModelRow(
        f'{term.name} is {term.assumed:.6g}',
        f'the stars put it at {term.asked:.6g}, {term.significance:.1f} sigma from it',
        _p(math.erfc(term.significance / math.sqrt(2))),
        f'estimate {term.name} (estimate) or widen its prior (prior_sigma)',
    )


def _detector_and_images(found: ModelChecks) -> Iterator[ModelRow]:
    step = found.step
    yield ModelRow(
        'The detector has no step',
        f'{_px(abs(step.size_px))} in {step.moved} at {step.across} = {step.place_px:.0f}',
        _p(step.p_value),
        'columns or rows are lost or shifted there: check the read-out',
    )
    yield ModelRow(
        'The camera is the same in all images',
        f'varies by {_px(found.image_variation_px)} in a corner',
        '',
        'estimate with temperature, or calibrate each state by itself',
    )


def _px(value: float) -> str:
    return f'{value:.3g} px'


def _p(value: float) -> str:
    """A p-value as text; empty where nothing was tested."""
    if math.isnan(value):
        return ''
    return '< 1e\N{MINUS SIGN}6' if value < 1e-6 else f'{value:.2g}'
