# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict of a report in words."""

import dataclasses
import math

import numpy as np
import pytest

from starcal_ground.report import verdict
from starcal_ros.records import GateCheck, SigmaPart, TemperatureTerms

GATE = (
    GateCheck('residual', 'max_residual_rms_px', 0.2, 1.0, 'px', True),
    GateCheck('step', 'max_step_px', math.nan, 10.0, 'px', None, 'no calibration was active'),
    GateCheck('turn', 'max_step_rotation_deg', math.nan, 1.0, 'deg', None,
              'no calibration was active'),
    GateCheck('distance of cx', 'max_held_term_sigma', 0.00646, 5.0, 'sigma', True, 'put at 319'),
    GateCheck('coverage', 'min_coverage', 0.1, 0.3, '', False),
)  # fmt: skip


def test_checks_that_were_not_made_did_not_pass() -> None:
    sentence = 'Checks: 1 failed, 2 passed, 2 not checked (step, turn: no calibration was active).'
    assert verdict.checks_sentence(GATE) == sentence
    assert verdict.checks_sentence(GATE[:1]) == 'Checks: 1 passed.'
    assert verdict.checks_sentence(()) == ''
    # Failed checks come first, and sigmas have one name.
    rows = verdict.check_rows(GATE)
    names = ['coverage', 'residual', 'step', 'turn', 'distance of cx']
    assert [check.name for check, *_ in rows] == names
    assert rows[0][1:4] == ('failed', '0.1', 'at least 0.3')
    assert rows[-1][1:] == ('passed', '0.0 sigma', 'at most 5 sigma', '')


def test_the_precision_is_that_of_map_and_budget(tiny) -> None:
    assert tiny.maps is not None
    sigma = np.full((10, 10), 0.2)
    sigma[0, :2] = 9.0
    budget = (
        SigmaPart('total', 0.25, 8.0, ''),
        SigmaPart('stars', 0.2, 0.2, ''),
        SigmaPart('velocity', 0.001, 0.001, ''),
        SigmaPart('fine structure', 0.15, 0.15, ''),
        SigmaPart('star tracker noise', 0.0, 7.9, ''),
    )
    shown = dataclasses.replace(
        tiny,
        sigma_budget=budget,
        maps=dataclasses.replace(tiny.maps, shape_sigma_arcsec=sigma),
    )
    assert verdict.precision_sentences(shown)[0] == (
        'Camera alone: the 1-sigma of a line of sight is 0.25″ rms over the detector, at most '
        '0.2″ over 98 % of it, 9″ at worst. Largest causes: stars (0.2″), fine structure (0.15″).'
    )


MEND = (
    'Do not use it for navigation. Find the causes of the failed checks (starcal diagnose), mend'
    ' them and calibrate again.'
)


@pytest.mark.parametrize(
    ('failed', 'note', 'step'),
    [
        ((), 'met', 'To lower a sigma most, {statement}.'),
        (
            ('requirements',),
            'missed by 4 arcsec; take more images',
            (
                'The sigmas hold, but miss a requirement; '
                'largest 1-sigma of line_of_sight, largest 1-sigma of map: take more images.'
            ),
        ),
        (('requirements',), 'missed by 4', 'The sigmas hold, but miss a requirement.'),
        (('requirements', 'min_images'), 'missed by 4 arcsec; take more images', MEND),
        (('min_images',), 'met', MEND),
    ],
)
def test_the_next_step_is_the_remedy_of_a_missed_requirement(tiny, failed, note, step) -> None:
    """A sound calibration gets the statement that lowers a sigma most, or nothing."""
    assert tiny.statements[0].option == 'star_tracker_slow_arcsec'
    gate = tuple(
        dataclasses.replace(
            check,
            passed=check.passed and check.option not in failed,
            note=note if check.option == 'requirements' else check.note,
        )
        for check in tiny.gate
    )
    judged = dataclasses.replace(tiny, accepted=not failed, gate=gate)
    assert verdict.next_step(judged) == step.format(statement=tiny.statements[0])
    if not failed:
        assert verdict.next_step(dataclasses.replace(judged, statements=())) == ''


@pytest.mark.parametrize(
    ('worst_px', 'variation_px', 'field', 'varies'),
    [
        (0.86, 0.02, '0.25 px rms per axis, at most 0.86 px', '0.02 px'),
        (1e-4, 4e-6, 'less than 0.001 px everywhere', 'less than 0.001 px'),
    ],
)
def test_a_length_that_no_image_shows_has_no_digits(
    tiny, worst_px, variation_px, field, varies
) -> None:
    assert tiny.model_checks is not None
    checks = dataclasses.replace(
        tiny.model_checks,
        field_rms_px=0.25,
        field_worst_px=worst_px,
        image_variation_px=variation_px,
    )
    first_ns = tiny.time_ns - 540 * 10**9
    shown = dataclasses.replace(
        tiny, model_checks=checks, zero_skew_cost_px=0.5, first_image_ns=first_ns
    )
    mean = 'the calibration is that of the mean over the 9 minutes of the images'
    assert verdict.model_sentences(shown) == [
        f'Field in addition to the lens model: {field}; another lens_model may lower it.',
        'camera_info, without field and skew, differs from the calibration by at most 0.5 px.',
        'For lines of sight with the field use starcal lookup.',
        f'The camera varies by {varies} in a corner; {mean}.',
    ]
    assert verdict.model_sentences(dataclasses.replace(shown, model_checks=None)) == []


def test_the_summary_is_a_line() -> None:
    turns = ((1e-5, 0.0, 0.0), (1e-6,) * 3)
    terms = TemperatureTerms(20.0, (4e-5,), (1e-6,), *turns, 'left out: this')
    assert verdict.thermal_summary(terms) == (
        'a1 +0.0000400 (0.000001) /degC; alignment +2.063 (0.21), +0.000 (0.21), +0.000 (0.21) '
        'arcsec/degC; reference 20 degC; left out: this'
    )
    assert verdict.thermal_summary(TemperatureTerms(20.0)) == 'no terms; reference 20 degC'
    both = TemperatureTerms(20.0, (4e-5, 2e-6), (1e-6, 1e-7))
    assert '; a2 +0.00000200 (0.0000001) /degC^2;' in verdict.thermal_summary(both)
