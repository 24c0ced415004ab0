# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Statements of an ensemble that are wrong, each with what is said; no star is needed for it."""

from collections.abc import Callable
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from sample_records import model_checks  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation
from worlds import campaign, estimated, honesty, observed, options_of, solved  # type: ignore[import-not-found]

from starcal_ros.arrays import Floats
from starcal_ros.assessment.gate import GateOptions, model_gate, reasons_of
from starcal_ros.assessment.model_checks import check_sigmas
from starcal_ros.assessment.stated import check_statements, with_doubts
from starcal_ros.constants import SPEED_OF_LIGHT_M_S
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import Ensemble, HeldTerm, StarObservations, StatementCheck
from starcal_ros.sky.astrometry import apparent_directions, earth_velocity_c
from starcal_ros.sky.catalog import load_catalog
from studies.worlds import World

CATALOG = load_catalog(None, 8.0)
TURN_RAD_S = np.array([0.0, 1e-3, 0.0])  # 3.4 degrees from image to image
Changed = Callable[[StarObservations], StarObservations]


def earth_m_s(time_ns: int) -> Floats:
    return earth_velocity_c(time_ns) * SPEED_OF_LIGHT_M_S


def orbit_m_s(time_ns: int) -> Floats:
    angle = 2.0 * np.pi * (time_ns % 5_700_000_000_000) / 5.7e12
    return 7.6e3 * np.array([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])


VELOCITY_M_S: dict[str, Callable[[int], Floats]] = {
    'in a low orbit': lambda t: earth_m_s(t) + orbit_m_s(t),
    'opposite': lambda t: -earth_m_s(t),
    'opposite in a low orbit': lambda t: -earth_m_s(t) - orbit_m_s(t),
    'about the Sun': lambda t: earth_m_s(t) + np.array([0.0, 0.0, 6e4]),
}


def stating(velocity: str) -> Changed:
    """Observations with the directions of another velocity than that of the Earth."""

    def changed(image: StarObservations) -> StarObservations:
        rows, _ = CATALOG.rows_of(image.catalog_id)
        stated_m_s = VELOCITY_M_S[velocity](image.time_ns)
        seen = apparent_directions(CATALOG, image.time_ns, stated_m_s, rows)
        return dataclasses.replace(image, direction_icrf=seen)

    return changed


def turning(factor: float) -> Changed:
    """Attitudes that turn evenly, with that rate times a factor."""

    def changed(image: StarObservations) -> StarObservations:
        late_s = 1e-9 * since_1970(image).time_ns
        attitude = Rotation.from_rotvec(TURN_RAD_S * late_s).as_quat()
        rate = factor * TURN_RAD_S
        return dataclasses.replace(
            image, icrf_from_star_tracker_xyzw=attitude, star_tracker_rate_rad_s=rate
        )

    return changed


def with_fields(**fields: Any) -> Changed:
    return lambda image: dataclasses.replace(image, **fields)


def of_other_places(image: StarObservations) -> StarObservations:
    return dataclasses.replace(image, direction_icrf=np.roll(image.direction_icrf, 1, axis=0))


def of_one_star(image: StarObservations) -> StarObservations:
    """Its directions do not show the velocity along it, which is taken to be that of the Earth."""
    return dataclasses.replace(
        image,
        catalog_id=np.repeat(image.catalog_id[:1], len(image)),
        direction_icrf=np.repeat(image.direction_icrf[:1], len(image), axis=0),
    )


def since_1970(image: StarObservations) -> StarObservations:
    """Stamps that count from the first image: one a minute."""
    _, ensemble = observed(9)
    return dataclasses.replace(image, time_ns=image.time_ns - ensemble.images[0].time_ns)


def as_it_is(image: StarObservations) -> StarObservations:
    return image


def changed_by(change: Changed) -> Ensemble:
    """Observations with the velocity of the Earth, changed."""
    return Ensemble(tuple(map(change, observed(9)[1].images)))


@pytest.mark.parametrize(
    ('change', 'options', 'name', 'passed', 'note'),
    [
        # What the velocity may be is a table of its own: test/onboard/sky/test_velocity.py.
        (as_it_is, {}, 'velocity', True, 'is 0.0 km/s from that of the Earth'),
        (stating('in a low orbit'), {}, 'velocity', True, '7.6 km/s from'),
        (stating('opposite'), {}, 'velocity', False, 'change its sign'),
        (
            stating('opposite in a low orbit'),
            *({}, 'velocity', None, 'a date half a year off; if right, state velocity_sigma_m_s'),
        ),
        (
            stating('opposite in a low orbit'),
            *({'velocity_sigma_m_s': 10.0}, 'velocity', None, '; 10 m/s are stated'),
        ),
        (
            stating('about the Sun'),
            {},
            'velocity',
            None,
            '60.0 km/s from that of the Earth, as of',
        ),
        (of_other_places, {}, 'velocity', False, 'faster than any spacecraft'),
        (of_one_star, {}, 'velocity', True, 'is 0.0 km/s from that of the Earth'),
        (with_fields(catalog_digest='other'), {}, 'velocity', None, 'catalog is not that of'),
        (as_it_is, {'shutter': 'rolling', 'readout_s': 0.05}, 'readout_s', True, '60 s apart'),
        (
            as_it_is,
            *({'shutter': 'rolling', 'readout_s': 90.0}, 'readout_s', False),
            'a read-out of 90 s, images 60 s apart: state readout_s in seconds',
        ),
        (turning(1.0), {}, 'rates', True, 'the rates are those of the turns'),
        (turning(-1.0), {}, 'rates', False, 'opposite to the turn from image to image'),
        (turning(math.degrees(1.0)), {}, 'rates', False, 'in degrees per second: send rad/s'),
        (turning(3.0), {}, 'rates', None, 'the turns from image to image are not by the rates'),
        (as_it_is, {}, 'rates', None, 'no even turns from image to image show the rates'),
        (since_1970, {}, 'clock', None, 'stamped before 1990-01-01'),
    ],
)
def test_a_statement_is_confirmed_contradicted_or_listed_as_not_checked(
    change: Changed, options: dict[str, Any], name: str, passed: bool | None, note: str
) -> None:
    found = check_statements(changed_by(change), CalibrationOptions(**options), CATALOG)
    (check,) = (one for one in found if one.name == name)
    assert check.passed is passed and note in check.note
    # One line, and a failed one is the reason of a refusal.
    assert len(check.note) <= 200 and '\n' not in check.note
    checks = model_checks()
    gate = tuple(model_gate(dataclasses.replace(checks, statements=(check,)), GateOptions()))
    assert (gate[0].name, gate[0].passed) == (f'{name} as stated', passed)
    assert (check.note in reasons_of(gate)) == (passed is False)


@pytest.mark.parametrize(
    ('stated', 'named'),
    [
        ({}, ''),  # 20 arcsec, as it is
        ({'star_tracker_sigma_arcsec': (5.0, 5.0, 5.0)}, ''),
        ({'star_tracker_sigma_arcsec': (0.1, 0.1, 0.1)}, '0.1″ stated, 16.4″'),
        ({'star_tracker_slow_arcsec': 1000.0}, '1000″ stated, '),
        ({'lens_residual_px': 0.5}, '0.5 px stated, 0.00'),
        ({'star_tracker_sigma_arcsec': (0.1, 0.1, 0.1), 'method': 'single'}, ''),  # exact
    ],
)
def test_a_stated_sigma_is_named_where_the_images_contradict_it(stated, named) -> None:
    options = options_of(campaign(World(), 1).scenario, **stated)
    notes = [one.note for one in check_sigmas(solved(World(), 1, **stated), options)]
    assert [note.startswith(named) for note in notes] == [True] * bool(named), notes


@pytest.mark.parametrize('sigma_m_s', [math.nan, 0.0, 2e4])
def test_what_nobody_stated_is_not_listed(sigma_m_s: float) -> None:
    """The velocity of the Earth stands in: unknown, that of a site, or with that of an orbit."""
    unknown = with_fields(
        velocity_sigma_m_s=sigma_m_s, star_tracker_rate_rad_s=np.full(3, math.nan)
    )
    assert check_statements(changed_by(unknown), CalibrationOptions(), CATALOG) == ()


@pytest.mark.parametrize('velocity', ['opposite', 'opposite in a low orbit'])
def test_a_velocity_of_the_wrong_sign_is_in_the_sigma(velocity: str) -> None:
    """With the 10 m/s of a velocity that is given, the error is 8 sigma rms, 14 at worst."""
    doubted = with_doubts(changed_by(stating(velocity)), CATALOG)
    (sigma_m_s,) = {image.velocity_sigma_m_s for image in doubted.images}
    assert 55e3 < sigma_m_s < 80e3  # twice the velocity
    given, right = observed(9)
    found = estimated(given, doubted, velocity_sigma_m_s=-1.0)
    assert honesty(given, found, np.zeros_like)[0] < 2.0
    assert with_doubts(right, CATALOG) is right


def test_what_the_stars_alone_do_not_determine_is_not_checked() -> None:
    held = (HeldTerm('velocity_z_m_s', 0.0, math.nan, math.nan), HeldTerm('cx', 0.0, 1.0, 1.0))
    checks = dataclasses.replace(model_checks(), held=held, statements=())
    rows = [one for one in model_gate(checks, GateOptions()) if 'assumed' in one.name]
    assert [one.passed for one in rows] == [None, True]
    assert rows[0].note == 'the stars alone do not determine it'
    assert not reasons_of(rows)


@pytest.mark.parametrize(
    'wrong',
    [
        {'statements': (StatementCheck('velocity', False, 'the velocity is opposite'),)},
        {'held': (HeldTerm('velocity', 0.0, 6e4, 1e3),)},
        {'held': (HeldTerm('velocity', 0.0, 6e4, 1e3, evidence=3.0),)},  # which does not decide
    ],
)
def test_a_wrong_statement_is_named_where_it_looks_like_a_camera_that_changes(wrong) -> None:
    checks = dataclasses.replace(
        model_checks(), image_variation_px=0.4, **{'held': (), 'statements': (), **wrong}
    )
    reasons = reasons_of(model_gate(checks, GateOptions()))
    assert any('a wrong velocity looks like it: first correct that' in one for one in reasons)
    assert not any('one focus' in one for one in reasons)


@pytest.mark.parametrize(
    ('evidence', 'sigmas'), [(math.nan, 12.0), (8.0, 4.0), (-3.0, 0.0), (1e3, 12.0)]
)
def test_a_distance_counts_as_much_as_the_evidence(evidence: float, sigmas: float) -> None:
    assert HeldTerm('cx', 0.0, 12.0, 1.0, evidence).significance == pytest.approx(sigmas)
