# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Results in words: parameters, checks, assumptions, precision by cause and the next step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np

from starcal_ground.comparison import alignment_difference_rad
from starcal_ros import records
from starcal_ros.arrays import Floats
from starcal_ros.assessment.requirements import QUANTITIES, requirement_answers, REQUIREMENTS
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.text import p_value_text, significant, to_sigma

INFORMATIVE_SIGMAS = 2.0
"""Distance from an assumed value below which the value that the stars ask for is noise."""

VISIBLE_PX = 0.001
"""Length below which a field or a variation is shown as none: no campaign of images shows it."""

_MOST_OF_DETECTOR = 0.98
_MATTERS = 0.05  # fraction of the variance
_NAMED_CAUSES, _NAMED_SHARE = 3, 0.2  # most causes in a sentence; least part of the sigma


_UNITS = {
    **{name: quantity.units[0] for name, quantity in QUANTITIES.items()},
    **{f'{name}_temperature': 'arcsec/degC' for name in records.ALIGNMENT_NAMES},
    'focal_temperature_1': '/degC',
    'focal_temperature_2': '/degC²',
    'tau_x': 'rad',
    'tau_y': 'rad',
}
"""By parameter; other coefficients of the lens have none."""
_RESULTS = {False: 'failed', True: 'passed', None: 'not checked'}


def parts_that_matter(budget: Sequence[records.SigmaPart]) -> list[records.SigmaPart]:
    """Return the total, then the causes of more than 5 % of a variance, the largest first."""
    if not budget:
        return []
    total = next(part for part in budget if part.cause == records.TOTAL)

    def share(part: records.SigmaPart) -> float:
        of_map = part.map_arcsec**2 / max(total.map_arcsec**2, 1e-300)
        return max(of_map, part.pointing_arcsec**2 / max(total.pointing_arcsec**2, 1e-300))

    causes = [part for part in budget if part.cause != records.TOTAL and share(part) > _MATTERS]
    return [total, *sorted(causes, key=share, reverse=True)]


def check_rows(
    gate: Sequence[records.GateCheck],
) -> list[tuple[records.GateCheck, str, str, str, str]]:
    """Checks, the failed ones first, each with its result, value, limit and note as text."""
    rows = []
    for check in sorted(gate, key=lambda check: check.passed is not False):
        value, limit, note = check.found_text, '', check.note
        if check.unit == 'sigma' and value and math.isfinite(check.found):
            value = f'{check.found:.1f} sigma'
            note = '' if check.passed and check.found < INFORMATIVE_SIGMAS else note
        if check.option:
            limit = f'{"at least" if check.is_least else "at most"} {check.limit_text}'
        rows.append((check, _RESULTS[check.passed], value, limit, note))
    return rows


def checks_sentence(gate: Sequence[records.GateCheck]) -> str:
    """How many checks passed, failed and were not made, and why not; empty without a gate."""
    if not gate:
        return ''
    counts = [(name, sum(check.passed is key for check in gate)) for key, name in _RESULTS.items()]
    text = ', '.join(f'{count} {name}' for name, count in counts if count or name == 'passed')
    reasons: dict[str, list[str]] = {}
    for check in gate:
        if check.passed is None and check.note:
            name = check.name.removesuffix(' as stated').removesuffix(' from its assumed value')
            reasons.setdefault(check.note, []).append(name.removeprefix('distance of '))
    texts = [f'{", ".join(names)}: {note}' for note, names in reasons.items()]
    why = f' ({"; ".join(texts)})' if texts else ''
    return f'Checks: {text}{why}.'


def precision_sentences(calibration: records.Calibration) -> list[str]:
    """1-sigma of the lines of sight over the detector, and its largest causes."""
    maps, budget = calibration.maps, parts_that_matter(calibration.sigma_budget)
    if maps is None:
        return []
    sentences = [_precision('Camera alone', maps.shape_sigma_arcsec, budget, 'map_arcsec')]
    if calibration.has_alignment:
        frame, sigma = f'In the frame {calibration.parent_frame}', maps.line_of_sight_sigma_arcsec
        sentences.append(_precision(frame, sigma, budget, 'pointing_arcsec'))
    return sentences


def _precision(scope: str, sigma: Floats, budget: Sequence[records.SigmaPart], of: str) -> str:
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


def in_sentences(calibration: records.Calibration) -> list[str]:
    """Sentences on the verdict: reasons, met requirements, checks, precision, next step."""
    # A requirement that is missed is among the reasons.
    met = [text for text in requirement_answers(calibration) if text.endswith(': met')]
    sentences = [f'{text[0].upper()}{text[1:]}.' for text in (*calibration.reasons, *met)]
    sentences.append(checks_sentence(calibration.gate) or 'The gate checks are not recorded.')
    sentences += precision_sentences(calibration)
    if step := next_step(calibration):
        sentences.append(f'Next: {step}')
    return [sentence.replace(' arcsec', '″') for sentence in sentences]


def next_step(calibration: records.Calibration) -> str:
    """
    The measure that lowers a missed requirement, or else a sigma most; empty if there is none.

    A reason to refuse has its own remedy.
    """
    if calibration.accepted:
        return ' '.join(f'To lower a sigma most, {row}.' for row in calibration.statements[:1])
    failed = [check for check in calibration.gate if check.passed is False]
    if {check.option for check in failed} == {REQUIREMENTS}:
        names: dict[str, list[str]] = {}  # names of the sigmas, by their step
        for check in failed:
            # Behind the first semicolon of the note is the remedy of the largest cause.
            names.setdefault(check.note.partition('; ')[2], []).append(check.name)
        steps = [f'{", ".join(of)}: {step}' for step, of in names.items() if step]
        return f'{"; ".join(["The sigmas hold, but miss a requirement", *steps])}.'
    return (
        'Do not use it for navigation. Find the causes of the failed checks (starcal diagnose),'
        ' mend them and calibrate again.'
    )


def model_sentences(calibration: records.Calibration) -> list[str]:
    """Sentences on the field, a camera without it, and changes; none where not recorded."""
    checks = calibration.model_checks
    if checks is None:
        return []
    minutes = (calibration.time_ns - calibration.first_image_ns) / NANOSECONDS_PER_SECOND / 60
    field = f'{_px(checks.field_rms_px)} rms per axis, at most {_px(checks.field_worst_px)}'
    if checks.field_worst_px < VISIBLE_PX:
        field = f'{_px(checks.field_worst_px)} everywhere'
    cost, varies = _px(calibration.zero_skew_cost_px), _px(checks.image_variation_px)
    mean = f'the mean over the {significant(minutes, 2)} minutes of the images'
    return [
        f'Field in addition to the lens model: {field}; another lens_model may lower it.',
        f'camera_info, without field and skew, differs from the calibration by at most {cost}.',
        'For lines of sight with the field use starcal lookup.',
        f'The camera varies by {varies} in a corner; the calibration is that of {mean}.',
    ]


def _px(value: float) -> str:
    return f'less than {VISIBLE_PX:g} px' if value < VISIBLE_PX else f'{significant(value, 3)} px'


@dataclass(frozen=True)
class ParameterRow:
    """Row of the parameter table; numbers as text, empty if absent."""

    name: str
    unit: str
    sigma: str
    change: str
    change_sigmas: str
    value: str = ''
    prior: str = ''


def parameter_rows(
    calibration: records.Calibration, prior: records.CameraGeometry | None
) -> list[ParameterRow]:
    """Value, sigma and change of each camera parameter."""
    camera, sigma = calibration.geometry.camera, calibration.sigma[:-3]
    if prior and not prior.camera.has_lens(camera.model):
        prior = None  # parameters of another lens model are no start of these
    changes = camera.parameters - (prior.camera.parameters if prior else camera.parameters)
    rows = []
    for k, name in enumerate(camera.parameter_names):
        known, changed = sigma[k] > 0, prior and changes[k]
        held = '' if name in calibration.estimated else 'held, ' if known else 'held'
        rows.append(
            ParameterRow(
                name=name,
                unit=_UNITS.get(name, ''),
                value=to_sigma(camera.parameters[k], sigma[k]),
                sigma=held + (significant(sigma[k], 2) if known else ''),
                prior=significant(prior.camera.parameters[k], 8) if prior else '',
                change=to_sigma(changes[k], sigma[k], '+') if changed else '',
                change_sigmas=f'{changes[k] / sigma[k]:+.1f}' if changed and known else '',
            )
        )
    return rows


def alignment_rows(
    calibration: records.Calibration, prior: records.CameraGeometry | None
) -> list[ParameterRow]:
    """
    Change and sigma of the alignment about each axis, arcsec; none of the camera alone.

    A prior alignment that was found by the same images is not one to compare with.
    """
    if not calibration.has_alignment:
        return []
    if 'alignment' in calibration.provenance.get(records.FOUND, ''):
        prior = None
    sigma = calibration.sigma[-3:] / ARCSECOND_RAD
    changes = (
        alignment_difference_rad(calibration.geometry, prior) / ARCSECOND_RAD
        if prior
        else np.zeros(3)
    )
    return [
        ParameterRow(
            name=axis,
            unit='arcsec',
            sigma=f'{sigma[k]:.2f}',
            change=f'{changes[k]:+.2f}' if prior else '',
            change_sigmas=f'{changes[k] / sigma[k]:+.1f}' if prior and sigma[k] > 0 else '',
        )
        for k, axis in enumerate('xyz')
    ]


def thermal_summary(thermal: records.TemperatureTerms) -> str:
    """One line of text with the terms, their sigmas and the reference."""
    parts = [
        f'a{k} {to_sigma(value, sigma, "+")} ({significant(sigma, 2)}) /degC'
        + (f'^{k}' if k > 1 else '')
        for k, (value, sigma) in enumerate(
            zip(thermal.focal_per_degc, thermal.focal_per_degc_sigma, strict=True), start=1
        )
    ]
    if thermal.alignment_rate_rad_per_degc:
        rates = np.degrees(thermal.alignment_rate_rad_per_degc) * 3600.0
        sigmas = np.degrees(thermal.alignment_rate_rad_per_degc_sigma) * 3600.0
        axes = (
            f'{rate:+.3f} ({significant(sigma, 2)})'
            for rate, sigma in zip(rates, sigmas, strict=True)
        )
        parts.append('alignment ' + ', '.join(axes) + ' arcsec/degC')
    text = f'{"; ".join(parts) or "no terms"}; reference {thermal.reference_degc:g} degC'
    return text + (f'; {thermal.note}' if thermal.note else '')


def alignment_summary(one: records.StarTrackerAlignment) -> str:
    """One line of text: images, 1-sigma of alignment and mounting, drift."""
    aligned, mounted = (
        np.sqrt(np.diag(covariance)) / ARCSECOND_RAD
        for covariance in (one.alignment_covariance_rad2, one.mounting_covariance_rad2)
    )
    text = f'{one.frame}: {one.images} images, alignment within {_three(aligned)} arcsec'
    if mounted.any():
        text += f', mounting within {_three(mounted)}'
    if np.isfinite(one.drift_p_value):
        text += (
            f'; drift {one.drift_arcsec:.1f} arcsec (p-value {p_value_text(one.drift_p_value)})'
        )
    return text


def _three(values: Floats) -> str:
    return ', '.join(f'{value:.1f}' for value in values)


def sigma_text(name: str, sigma: float) -> str:
    """1-sigma of a parameter with its unit."""
    if not math.isfinite(sigma):
        return 'unobservable'
    unit = _UNITS.get(name, '')
    if unit.startswith('arcsec'):
        return f'{sigma / ARCSECOND_RAD:.2f} {unit}'
    return f'{significant(sigma, 2)} {unit}'.rstrip()
