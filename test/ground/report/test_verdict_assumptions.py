# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows on the assumptions of a calibration."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from pathlib import Path
from typing import Any

import pytest

from starcal_ground.report.verdict import model_rows, ModelRow
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import HeldTerm

Changed = Callable[..., list[ModelRow]]


@pytest.fixture
def rows(tiny_products: Path) -> Changed:
    """Rows of the small bag's calibration with some of its model checks changed."""
    calibration = read_calibration(tiny_products / 'calibration.json')
    checks = calibration.model_checks
    assert checks is not None
    calibration = dataclasses.replace(
        calibration, zero_skew_cost_px=0.5, first_image_ns=calibration.time_ns - 540 * 10**9
    )

    def changed(**changes: Any) -> list[ModelRow]:
        found = dataclasses.replace(checks, **changes)
        return model_rows(dataclasses.replace(calibration, model_checks=found))

    return changed


@pytest.mark.parametrize(
    ('held', 'by_stars', 'remedy'),
    [
        (HeldTerm('cx', 320.0, 326.0, 2.0), '326 by the stars, 320 assumed', 'estimate it'),
        (HeldTerm('velocity_x_m_s', 0.0, 6e4, 2e4), 'the stars add 60000 to it', 'correct it so'),
    ],
)
def test_rows_say_what_was_found_and_what_to_do(
    held: HeldTerm, by_stars: str, remedy: str, rows: Changed
) -> None:
    lens, term, *others = rows(field_rms_px=0.25, field_worst_px=0.86, held=(held,))
    assert lens.found == (
        'field of 0.25 px rms per axis, at most 0.86 px; '
        'camera_info, without field and skew, differs from the calibration by at most 0.5 px'
    )
    assert lens.p_value == '' and 'starcal lookup' in lens.remedy
    assert term.assumption == f'{held.name} is as assumed'
    assert term.found == f'{by_stars}: 3.0 sigma of the difference'
    assert float(term.p_value) == pytest.approx(0.0027)
    assert term.remedy.startswith(remedy)
    assert [row.assumption for row in others] == [
        'The detector has no step',
        'The camera is the same in all images',
    ]
    assert all(row.remedy for row in others)


def test_a_length_that_no_image_shows_has_no_digits(rows: Changed) -> None:
    lens, *_, camera = rows(field_rms_px=3e-5, field_worst_px=1e-4, image_variation_px=4e-6)
    assert lens.found.startswith('field of less than 0.001 px everywhere; ')
    assert camera.found == (
        'varies by less than 0.001 px in a corner; the calibration is that of the mean over the'
        ' 9 minutes of the images'
    )


def test_values_that_the_stars_do_not_contradict_share_one_row(rows: Changed) -> None:
    """A velocity of 478 km/s with a sigma of 627 km/s states nothing of the spacecraft."""
    held = (HeldTerm('cx', 320.0, 326.0, 20.0), HeldTerm('velocity x', 0.0, 478e3, 627e3))
    _, term, *others = rows(held=held)
    assert term.assumption == 'cx is 320, velocity x is 0'
    assert term.found == 'the stars agree, within 0.8 sigma of the difference'
    assert not any('478' in row.found for row in (term, *others))


def test_a_calibration_without_checks_has_no_rows(tiny_products: Path) -> None:
    calibration = read_calibration(tiny_products / 'calibration.json')
    assert model_rows(dataclasses.replace(calibration, model_checks=None)) == []
