# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Budget of the sigma of lines of sight: against estimates with an assumption switched off."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
from worlds import campaign, each_image, estimate_of, options_of, solved  # type: ignore[import-not-found]

from starcal_ros.assessment import budget
from starcal_ros.assessment.budget import sigma_budget, statements
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import equations
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import BUDGET_COLUMNS, BUDGET_ROWS, SigmaPart, Statement
from studies.worlds import World

RAM = World(pointing='ram', velocity_m_s=1.0)  # pointings on one side of the sky
FIELDS = World(24, 'fields4', star_arcsec=3.0)


def estimate(world: World, **options: object) -> tuple[Estimate, CalibrationOptions]:
    return solved(world, 1, **options), options_of(campaign(world, 1).scenario, **options)


@functools.cache
def parts(world: World, **options: object) -> dict[str, SigmaPart]:
    return {part.cause: part for part in sigma_budget(*estimate(world, **options))}


def fall(before: SigmaPart, after: SigmaPart) -> tuple[float, float]:
    """Roots of the variances that are gone."""
    return (
        math.sqrt(max(before.map_arcsec**2 - after.map_arcsec**2, 0.0)),
        math.sqrt(max(before.pointing_arcsec**2 - after.pointing_arcsec**2, 0.0)),
    )


@pytest.mark.parametrize('world', [RAM, FIELDS], ids=['ram', 'fields'])
def test_the_total_is_the_rms_of_the_table(world: World) -> None:
    found, _ = estimate(world)
    camera = found.geometry.camera
    table = line_of_sight_table(camera, found.map_covariance, pixel_grid(camera, 25, 25))
    total = parts(world)['total']
    for part, column in (
        (total.map_arcsec, table.shape_sigma_arcsec),
        (total.pointing_arcsec, table.sigma_arcsec),
    ):
        assert part == pytest.approx(float(np.sqrt(np.mean(column**2))), rel=1e-9)


def test_the_parts_over_the_detector_are_those_of_its_pixels() -> None:
    found, _ = estimate(RAM)
    camera = found.geometry.camera
    pixels = pixel_grid(camera, BUDGET_COLUMNS, BUDGET_ROWS)
    table = line_of_sight_table(camera, found.map_covariance, pixels)
    budget_of = parts(RAM)
    total = np.array(budget_of['total'].map_over_detector_arcsec)
    assert total == pytest.approx(table.shape_sigma_arcsec, rel=1e-9)
    given = parts(RAM, velocity_sigma_m_s=0.0)['total'].map_over_detector_arcsec
    fallen = np.sqrt(np.maximum(total**2 - np.square(given), 0.0))
    velocity = np.array(budget_of['velocity'].map_over_detector_arcsec)
    # The estimate that is given it has amplitudes of its own, up to a tenth of the total.
    assert velocity == pytest.approx(fallen, abs=0.1 * total.max())
    assert velocity[0] > 2.0 * velocity[31]  # a change of focal length shows in the corners


@pytest.mark.parametrize('world', [World(), RAM, FIELDS], ids=['spread', 'ram', 'fields'])
def test_independent_causes_sum_to_the_total(world: World) -> None:
    found = dict(parts(world))
    total = found.pop('total')
    for axis in ('map_arcsec', 'pointing_arcsec'):
        summed = sum(getattr(part, axis) ** 2 for part in found.values())
        # Velocity, field and camera are correlated by some percent.
        assert summed == pytest.approx(getattr(total, axis) ** 2, rel=0.06), axis


def test_velocity_is_the_fall_of_an_estimate_that_is_given_it() -> None:
    part = parts(RAM)['velocity']
    given = parts(RAM, velocity_sigma_m_s=0.0)
    assert 'velocity' not in given
    of_map, _ = fall(parts(RAM)['total'], given['total'])
    assert part.map_arcsec == pytest.approx(of_map, rel=0.03)
    assert part.map_arcsec > 0.5 * parts(RAM)['total'].map_arcsec
    assert part.assumption == 'no barycentric one given: 20 km/s per axis assumed'
    stated = parts(RAM, velocity_sigma_m_s=10.0)['velocity']
    assert stated.assumption == '10 m/s per axis stated'
    assert parts(FIELDS)['velocity'].assumption == 'given: 10 m/s per axis assumed'
    assert stated.map_arcsec < 0.01 * part.map_arcsec


def test_a_held_parameter_is_the_fall_of_an_estimate_that_holds_it_exactly() -> None:
    kept = ('fx', 'skew', 'fy', 'cx', 'cy', 'k1', 'k2', 'p1', 'p2')
    exact, loose = (
        parts(RAM, estimate=kept, prior_sigma=(*[0.0] * 7, sigma, 0.0, 0.0))
        for sigma in (0.0, 2.0)
    )
    assert 'held parameters' not in exact
    part = loose['held parameters']
    of_map, of_pointing = fall(loose['total'], exact['total'])
    assert part.map_arcsec == pytest.approx(of_map, rel=0.02)
    assert part.pointing_arcsec == pytest.approx(of_pointing, rel=0.02)
    assert part.assumption == '1-sigma of the prior: k3 2'


def test_places_of_stars_are_the_fall_of_a_campaign_without_their_errors() -> None:
    part = parts(FIELDS)['star places']
    without = parts(dataclasses.replace(FIELDS, star_arcsec=0.0))
    of_map, _ = fall(parts(FIELDS)['total'], without['total'])
    # A part of the errors may be of the detector: the floor exceeds by 2 sigma what stars share.
    of_structure, _ = fall(parts(FIELDS)['fine structure'], without['fine structure'])
    assert part.map_arcsec > 0.5 * parts(FIELDS)['total'].map_arcsec
    # That estimate has other weights: the part is of those that allow for the errors.
    assert part.map_arcsec == pytest.approx(math.sqrt(of_map**2 - of_structure**2), rel=0.25)
    # Errors that no two observations share are noise.
    assert parts(World(3))['star places'].map_arcsec == 0.0


def test_a_slow_error_is_the_fall_of_an_estimate_that_has_none() -> None:
    part = parts(World())['star tracker slow error']
    stated = parts(World(), star_tracker_slow_arcsec=1e-3)
    _, of_pointing = fall(parts(World())['total'], stated['total'])
    assert part.pointing_arcsec == pytest.approx(of_pointing, rel=0.05)
    assert part.assumption.startswith('not given: as the noise assumed; estimated: ')
    assert parts(World())['field'].assumption.startswith('estimated, uncertainty included: ')
    assert parts(World())['star tracker noise'].assumption.startswith('20, 20, 20″ stated; ')


@pytest.mark.parametrize(
    ('world', 'option', 'scope', 'stated'),
    [
        (World(), 'star_tracker_slow_arcsec', 'pointing', {'star_tracker_slow_arcsec': 10.0}),
        (World(6), 'star_tracker_slow_arcsec', 'pointing', {'star_tracker_slow_arcsec': 10.0}),
        (RAM, 'observer_velocity_m_s', 'camera', {'velocity_sigma_m_s': 10.0}),
    ],
)
def test_a_statement_gives_the_sigma_of_an_estimate_that_has_it(
    world: World, option: str, scope: str, stated: dict[str, float]
) -> None:
    rows = statements(sigma_budget(*estimate(world)), *estimate(world))
    assert rows == tuple(sorted(rows, key=lambda row: row.after_arcsec / row.before_arcsec))
    row = next(row for row in rows if row.option.startswith(option))
    of = {'camera': 'map_arcsec', 'pointing': 'pointing_arcsec'}[scope]
    assert row.scope == scope and row.before_arcsec == getattr(parts(world)['total'], of)
    assert row.after_arcsec < 0.6 * row.before_arcsec
    after = getattr(parts(world, **stated)['total'], of)
    assert row.after_arcsec == pytest.approx(after, rel=0.1)
    assert f'state {row.option}: {scope} ' in str(row) and f'if it is {row.value}' in str(row)


def test_without_rates_the_shutter_is_asked_for_or_where_it_rolls_the_rates() -> None:
    made, unknown = campaign(World(), 1), np.full(3, np.nan)
    ensemble = each_image(made.ensemble, lambda *_: {'star_tracker_rate_rad_s': unknown})
    made = dataclasses.replace(made, ensemble=ensemble)

    def asked(**stated: Any) -> tuple[tuple[SigmaPart, ...], tuple[Statement, ...]]:
        found = estimate_of(made, **stated), options_of(made.scenario, **stated)
        budget = sigma_budget(*found)
        return budget, statements(budget, *found)

    still = {part.cause: part for part in asked(shutter='global')[0]}['total'].map_arcsec
    rates = 'star_tracker_rate_rad_s of the images'
    for stated, option in (
        ({}, f'shutter, or {rates}'),
        ({'shutter': 'rolling', 'readout_s': 0.02}, rates),
    ):
        row = next(row for row in asked(**stated)[1] if row.option == option)
        assert row.scope == 'camera' and row.before_arcsec > 3.0 * row.after_arcsec
        assert row.after_arcsec == pytest.approx(still, rel=0.1)  # as of other statements


def test_what_is_stated_is_not_asked_for() -> None:
    stated = {'star_tracker_slow_arcsec': 5.0, 'velocity_sigma_m_s': 10.0}
    found = estimate(RAM, **stated)
    assert statements(sigma_budget(*found), *found) == ()


def test_a_value_that_the_images_contradict_is_not_asked_for() -> None:
    """Attitudes in axes of another epoch are off by as much as they turn."""
    found = estimate(World(smooth_arcsec=1000.0))
    assert not [row for row in statements(sigma_budget(*found), *found) if 'slow' in row.option]


def test_known_unknowns_do_not_depend_on_their_units() -> None:
    found, _ = estimate(RAM)
    errors = found.posterior.errors
    assert errors is not None
    scale = np.ones((len(errors.root), 1))
    scale[found.linear.layout.places['velocity'].start] = 1e-24
    rescaled = dataclasses.replace(errors, root=errors.root * scale)
    T, again = (budget._known(one, found, ['velocity']) for one in (errors, rescaled))
    np.testing.assert_allclose(again @ again.T, T @ T.T, atol=1e-9)


def test_known_shapes_add_the_information_that_they_hide() -> None:
    breathing = World(6, breathing=3e-4)
    found, _ = estimate(breathing)
    errors = found.posterior.errors
    assert errors is not None
    T = budget._known(errors, found, [], budget._of_shapes(found, errors))
    given = found.sums, found.linear
    hidden = equations(*given, 1e-7).information
    hidden = hidden - equations(*given, found.posterior.shapes.sigma_px).information
    C = errors.root @ errors.root.T
    size = np.sqrt(np.diag(C))
    size[size == 0] = 1.0
    left = errors.root @ T @ T.T @ errors.root.T  # (C^-1 + hidden)^-1
    back = (left + left @ hidden @ C) / np.outer(size, size)
    np.testing.assert_allclose(back, C / np.outer(size, size), atol=1e-6)
    part = parts(breathing)['change from image to image']
    assert part.map_arcsec > 0.5 * parts(breathing)['total'].map_arcsec


def test_without_an_alignment_no_star_tracker_is_a_cause() -> None:
    found = {part.cause: part for part in sigma_budget(*estimate(RAM), has_alignment=False)}
    whole = parts(RAM)
    assert set(whole) - set(found) == {'star tracker noise', 'star tracker slow error'}
    for cause, part in found.items():
        assert part.map_arcsec == part.pointing_arcsec == whole[cause].map_arcsec
