# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Verdict of a report in words: checks, assumptions, the precision by cause and the next step."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.assessment.remedies import REMEDIES
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.records import Calibration, GateCheck, HeldTerm, parts_that_matter, SigmaPart
from starcal_ros.text import p_value_text, significant

INFORMATIVE_SIGMAS = 2.0
"""Distance from an assumed value below which the value that the stars ask for is noise."""

VISIBLE_PX = 0.001
"""Length below which a field or a variation is shown as none: no campaign of images shows it."""

_MOST_OF_DETECTOR = 0.98
_NAMED_CAUSES, _NAMED_SHARE = 3, 0.2  # most causes in a sentence; least part of the sigma
_SIGMA_LIMITS = {'max_map_sigma_px', 'max_line_of_sight_sigma_arcsec'}


_RESULTS = {False: 'failed', True: 'passed', None: 'not checked'}


def check_rows(gate: Sequence[GateCheck]) -> list[tuple[GateCheck, str, str, str, str]]:
    """Checks, the failed ones first, each with its result, value, limit and note as text."""
    rows = []
    for check in sorted(gate, key=lambda check: check.passed is not False):
        found, limit, note = check.found_text, '', check.note
        if check.unit == 'sigma' and found and math.isfinite(check.found):
            found = f'{check.found:.1f} sigma'
            note = '' if check.passed and check.found < INFORMATIVE_SIGMAS else note
        if note == 'no limit is set':
            limit = 'none'
        elif check.option:
            limit = f'{"at least" if check.is_least else "at most"} {check.limit_text}'
        rows.append((check, _RESULTS[check.passed], found, limit, note))
    return rows


def checks_sentence(gate: Sequence[GateCheck]) -> str:
    """How many checks passed, failed and were not made, and why not; empty without a gate."""
    if not gate:
        return ''
    counts = [(name, sum(check.passed is key for check in gate)) for key, name in _RESULTS.items()]
    text = ', '.join(f'{count} {name}' for name, count in counts if count or name == 'passed')
    reasons = dict.fromkeys(check.note for check in gate if check.passed is None and check.note)
    why = f' ({"; ".join(reasons)})' if reasons else ''
    return f'Checks: {text}{why}.'


def precision_sentences(calibration: Calibration) -> list[str]:
    """1-sigma of the lines of sight over the detector, and its largest causes."""
    maps, budget = calibration.maps, parts_that_matter(calibration.sigma_budget)
    if maps is None:
        return []
    sentences = [_precision('Camera alone', maps.shape_sigma_arcsec, budget, 'map_arcsec')]
    if calibration.has_alignment:
        frame, sigma = f'In the frame {calibration.parent_frame}', maps.line_of_sight_sigma_arcsec
        sentences.append(_precision(frame, sigma, budget, 'pointing_arcsec'))
    return sentences


def _precision(scope: str, sigma: Floats, budget: Sequence[SigmaPart], of: str) -> str:
    finite = sigma[np.isfinite(sigma)]
    if not len(finite):
        return f'{scope}: the lines of sight have no sigma.'
    most = float(np.quantile(finite, _MOST_OF_DETECTOR, method='inverted_cdf'))
    share, worst = f'{100 * _MOST_OF_DETECTOR:.0f} %', significant(float(finite.max()), 2)
    bound = f'at most {significant(most, 2)}″ over {share}'
    text = f'{scope}: the 1-sigma of a line of sight is'
    if not budget:
        return f'{text} {bound} of the detector, {worst}″ at worst.'
    total, *causes = [(getattr(part, of), part.cause) for part in budget]
    named = sorted((one for one in causes if one[0] > _NAMED_SHARE * total[0]), reverse=True)
    parts = ', '.join(
        f'{cause} ({significant(size, 2)}″)' for size, cause in named[:_NAMED_CAUSES]
    )
    return (
        f'{text} {significant(total[0], 2)}″ rms over the detector, {bound} '
        f'of it, {worst}″ at worst.{f" Largest causes: {parts}." if parts else ""}'
    )


def next_step(calibration: Calibration) -> str:
    """The measures against a refusal, or against the largest causes of the sigma."""
    if calibration.accepted:
        return ' '.join(_against_sigma(calibration))
    failed = [check.option for check in calibration.gate if check.passed is False]
    measures = dict.fromkeys(REMEDIES[option] for option in failed if option in REMEDIES)
    causes = (
        f': {"; ".join(measures)}. Then calibrate again.' if measures else ' and calibrate again.'
    )
    text = f'Do not use it for navigation. Correct the causes of the failed checks{causes}'
    steps = _against_sigma(calibration) if _SIGMA_LIMITS & set(failed) else []
    return ' '.join([text, *steps])


def _against_sigma(calibration: Calibration) -> list[str]:
    """A sentence with the measure against the largest cause of each sigma."""
    causes = parts_that_matter(calibration.sigma_budget)[1:]
    if not causes:
        return []
    steps = []
    scopes = (('camera', 'map_arcsec'), ('alignment', 'pointing_arcsec'))
    for scope, of in scopes if calibration.has_alignment else scopes[:1]:
        largest = max(causes, key=lambda part: getattr(part, of))
        remedy = REMEDIES.get(largest.cause)
        if remedy:
            steps.append(
                f'To reduce the sigma of the {scope} (largest cause: {largest.cause}), {remedy}.'
            )
    return steps + [f'To lower a sigma most, {row}.' for row in calibration.statements[:1]]


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
    step, cost_px = found.step, calibration.zero_skew_cost_px
    minutes = (calibration.time_ns - calibration.first_image_ns) / NANOSECONDS_PER_SECOND / 60
    field = f'field of {_px(found.field_rms_px)} rms per axis, at most {_px(found.field_worst_px)}'
    if found.field_worst_px < VISIBLE_PX:
        field = f'field of {_px(found.field_worst_px)} everywhere'
    return [
        ModelRow(
            'The lens model describes the lens',
            f'{field}; camera_info, without field and skew, differs from the calibration by at '
            f'most {_px(cost_px)}',
            '',
            'choose another lens_model; for lines of sight with the field use starcal lookup',
        ),
        *_held(found.held),
        ModelRow(
            'The detector has no step',
            f'{_px(abs(step.size_px))} in {step.moved} at {step.across} = {step.place_px:.0f}',
            _p(step.p_value),
            REMEDIES['detector step'],
        ),
        ModelRow(
            'The camera is the same in all images',
            f'varies by {_px(found.image_variation_px)} in a corner; the calibration is that of'
            f' the mean over the {significant(minutes, 2)} minutes of the images',
            '',
            REMEDIES['change from image to image'],
        ),
    ]


def _held(held: Sequence[HeldTerm]) -> Iterator[ModelRow]:
    """One row for each value that the stars contradict, and one for all others together."""
    agreeing = [term for term in held if term.significance < INFORMATIVE_SIGMAS]
    for term in held:
        if term.significance >= INFORMATIVE_SIGMAS:
            yield ModelRow(
                f'{term.name} is {significant(term.assumed, 6)}',
                f'the stars put it at {significant(term.estimated, 6)}: '
                f'{term.significance:.1f} sigma of the difference',
                _p(math.erfc(term.significance / math.sqrt(2))),
                f'estimate {term.name} (estimate) or widen its prior (prior_sigma)',
            )
    if agreeing:
        names = ', '.join(f'{term.name} is {significant(term.assumed, 6)}' for term in agreeing)
        worst = max(term.significance for term in agreeing)
        found = f'the stars agree, within {worst:.1f} sigma of the difference'
        yield ModelRow(names, found, _p(math.erfc(worst / math.sqrt(2))), '')


def _px(value: float) -> str:
    return f'less than {VISIBLE_PX:g} px' if value < VISIBLE_PX else f'{significant(value, 3)} px'


def _p(value: float) -> str:
    """A p-value as text; empty where nothing was tested."""
    return '' if math.isnan(value) else p_value_text(value)
