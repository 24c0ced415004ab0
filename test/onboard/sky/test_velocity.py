# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A velocity against that of the Earth: usual mistakes are named, right velocities are not."""

from collections.abc import Callable

import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Integers
from starcal_ros.constants import AU_M, NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.sky.astrometry import apparent_directions, earth_velocity_c
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.sky.velocity import doubt_of, off_earth_m_s, velocity_in

START_NS = 1_780_000_000 * NANOSECONDS_PER_SECOND  # May 2026
HOUR_NS = 3600 * NANOSECONDS_PER_SECOND
YEAR_NS = 8766 * HOUR_NS
TIMES_NS = START_NS + np.arange(0, HOUR_NS, HOUR_NS // 12)
ECLIPTIC = erfa.ecm06(*erfa.epj2jd(2000.0))
GM_EARTH, GM_SUN = 3.986004418e14, 1.32712440018e20
Velocity = Callable[[Integers], Floats]


def earth(times_ns: Integers) -> Floats:
    in_c = [earth_velocity_c(int(one)) for one in times_ns]
    return np.asarray(np.array(in_c) * SPEED_OF_LIGHT_M_S)


def orbit(times_ns: Integers, gm: float, size_m: float, e: float, phase: float) -> Floats:
    """Velocities (k, 3) of a Kepler orbit, in its plane."""
    since_s = (times_ns - times_ns[0]) / NANOSECONDS_PER_SECOND
    rate = np.sqrt(gm / size_m**3)
    mean = phase + rate * since_s
    anomaly = mean + 0.0
    for _ in range(60):
        anomaly -= (anomaly - e * np.sin(anomaly) - mean) / (1.0 - e * np.cos(anomaly))
    speed = rate * size_m / (1.0 - e * np.cos(anomaly))
    x, y = -speed * np.sin(anomaly), speed * np.sqrt(1.0 - e * e) * np.cos(anomaly)
    return np.stack([x, y, 0.0 * x], axis=-1)


def low_orbit(times_ns: Integers) -> Floats:
    turn = Rotation.from_euler('zx', [0.7, 0.9]).as_matrix()
    return np.asarray(earth(times_ns) + orbit(times_ns, GM_EARTH, 6.9e6, 0.001, 0.3) @ turn.T)


@pytest.mark.parametrize(
    ('stated', 'mistake', 'is_certain'),
    [
        (lambda t: -earth(t), 'opposite', True),
        (lambda t: np.repeat(-earth(t[:1]), len(t), axis=0), 'opposite', True),  # an option
        (lambda t: -low_orbit(t), 'opposite', False),
        (lambda t: earth(t + YEAR_NS // 2), 'opposite', False),
        (lambda t: earth(t) @ ECLIPTIC.T, 'along ecliptic axes', True),
        (lambda t: earth(t) @ ECLIPTIC, 'but was along those of the ICRF', True),
        (lambda t: earth(t)[:, [1, 0, 2]], 'its numbers are yxz', True),
        (lambda t: earth(t)[:, [2, 0, 1]], 'its numbers are zxy', True),
        (lambda t: low_orbit(t)[:, [1, 2, 0]], 'its numbers are yzx', False),
        (lambda t: earth(t) / 1e3, 'in km/s', True),
        (lambda t: low_orbit(t) / 1e3, 'in km/s', True),
        (lambda t: -earth(t) / 1e3, 'in km/s: state it in m/s; then opposite', True),
        (lambda t: earth(t) / (AU_M / 86400.0), 'in AU per day', True),
        (lambda t: earth(t) / SPEED_OF_LIGHT_M_S, 'in parts of the speed of light', True),
        (lambda t: low_orbit(t) - earth(t), 'relative to the Earth', False),
        (lambda t: (low_orbit(t) - earth(t)) / 1e3, 'relative to the Earth', True),
        (lambda t: 0.0 * earth(t), 'relative to the Earth', True),
        (lambda t: 1e2 * earth(t), 'faster than any spacecraft', True),
    ],
)
def test_a_usual_mistake_is_named(stated: Velocity, mistake: str, is_certain: bool) -> None:
    found = doubt_of(TIMES_NS.tolist(), stated(TIMES_NS))
    assert found is not None and mistake in found.mistake
    assert found.is_certain == is_certain
    # The sigma covers the error, to the velocity of an orbit.
    off_m_s = off_earth_m_s(TIMES_NS.tolist(), stated(TIMES_NS))
    assert found.sigma_m_s > off_m_s - 8e3
    assert len(f'the velocity is {found.mistake}') < 130


def about_the_sun(rng: np.random.Generator, times_ns: Integers) -> Floats:
    """A cruise at any phase: 0.4 to 8 AU, e to 0.6, some degrees from the ecliptic."""
    size_m = AU_M * float(np.exp(rng.uniform(np.log(0.4), np.log(8.0))))
    turn = Rotation.from_euler(
        'zxz', [*rng.uniform(0, 2 * np.pi, 1), 0.1 * rng.normal(), *rng.uniform(0, 2 * np.pi, 1)]
    )
    e, phase = rng.uniform(0.0, 0.6), rng.uniform(0.0, 2 * np.pi)
    return np.asarray(orbit(times_ns, GM_SUN, size_m, e, phase) @ turn.as_matrix().T @ ECLIPTIC)


def about_the_earth(rng: np.random.Generator, times_ns: Integers) -> Floats:
    """From a low orbit to beyond the Moon."""
    size_m = float(np.exp(rng.uniform(np.log(6.6e6), np.log(6e8))))
    e, phase = rng.uniform(0.0, min(0.7, 1.0 - 6.5e6 / size_m)), rng.uniform(0.0, 2 * np.pi)
    turn = Rotation.random(random_state=rng).as_matrix()
    return np.asarray(earth(times_ns) + orbit(times_ns, GM_EARTH, size_m, e, phase) @ turn.T)


def missions(
    of: Callable[[np.random.Generator, Integers], Floats],
) -> list[tuple[list[int], Floats]]:
    """Right missions of a minute to five days, at any time of the year."""
    rng = np.random.default_rng(53)
    made = []
    for _ in range(150):
        span_s = float(np.exp(rng.uniform(np.log(60.0), np.log(432000.0))))
        first_s = START_NS / NANOSECONDS_PER_SECOND + rng.uniform(0.0, 3e7)
        times_ns = (1e9 * (first_s + np.linspace(0.0, span_s, 8))).astype(np.int64)
        made.append((times_ns.tolist(), of(rng, times_ns)))
    return made


def test_a_right_velocity_is_never_doubted_near_the_earth_nor_a_certain_mistake() -> None:
    """About the Sun it may be that of the Earth beyond it by chance: a doubt, in the sigma."""
    assert all(doubt_of(*mission) is None for mission in missions(about_the_earth))
    doubts = [doubt_of(*mission) for mission in missions(about_the_sun)]
    assert not any(doubt.is_certain for doubt in doubts if doubt)
    # Slow ones beyond Jupiter may be relative to the Earth.
    named = [d for d in doubts if d and not d.mistake.startswith('relative to the Earth')]
    assert len(named) < 0.1 * len(doubts)


@pytest.mark.parametrize('radius_deg', [0.3, 5.0, 40.0])
def test_directions_show_the_velocity_that_they_were_made_with(radius_deg: float) -> None:
    catalog = load_catalog(None, 8.0)
    near = np.flatnonzero(catalog.direction_icrs[:, 2] > 0.3)
    middle = catalog.direction_icrs[near[0]]
    rows = np.flatnonzero(catalog.direction_icrs @ middle > np.cos(np.radians(radius_deg)))[:200]
    rows = rows if len(rows) > 1 else np.r_[near[0], near[1]]
    given_m_s = np.array([-2.1e4, 6.3e4, 1.7e4])
    seen = apparent_directions(catalog, START_NS, given_m_s, rows)
    found_m_s = velocity_in(seen, catalog, rows, START_NS)
    # Directions are rounded to 1e-16, which 0.3 degrees magnify 1e5 times.
    np.testing.assert_allclose(found_m_s, given_m_s, atol=0.1)
