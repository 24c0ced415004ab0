# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Check of a stated velocity without stars: against that of the Earth at the same time.

A spacecraft near the Earth has the Earth's velocity to 11.2 km/s.  One about the Sun may have any
other, so that a difference alone proves nothing.  Where a usual mistake explains it (the sign, the
axes, the unit, the body), what the mistake changes is the 1-sigma of the velocity.  The mistake is
certain where it explains the difference to 0.1 km/s, or where no body is so slow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import itertools
import math

import erfa
import numpy as np

from starcal_ros.arrays import Floats, Indices, Integers
from starcal_ros.constants import AU_M, FASTEST_M_S, NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.sky.astrometry import apparent_directions, earth_velocity_c, ESCAPE_M_S
from starcal_ros.sky.catalog import StarCatalog

# The velocity of the barycentre of the Earth and the Moon, or one about the Sun, is 12 to 25 m/s
# off; that of the Earth changes by 100 m/s in five hours, and one number may state all of them.
_EXACT_M_S = 100.0
# Neptune moves at 5 km/s: a smaller number is of another unit or about another body.
_SLOWEST_M_S = 1e3
_SHOWN_M_S = 1.0  # change of a velocity by the Sun in three minutes, by the Earth in less
_GM_EARTH = 3.986004418e14  # m^3/s^2, IERS Conventions 2010
_ICRF_FROM_ECLIPTIC = erfa.ecm06(*erfa.epj2jd(2000.0)).T
_TURNS: dict[str, Floats] = {
    'opposite to that of the Earth: change its sign, or a date half a year off': -np.eye(3),
    'along ecliptic axes: turn it to those of the ICRF': _ICRF_FROM_ECLIPTIC,
    'turned from ecliptic axes, but was along those of the ICRF: do not turn it': (
        _ICRF_FROM_ECLIPTIC.T
    ),
    **{
        f'along axes in another order: its numbers are {"".join("xyz"[k] for k in order)}, send'
        ' xyz': np.eye(3)[np.argsort(order)]
        for order in itertools.permutations(range(3))
        if order != (0, 1, 2)
    },
}
_UNITS = {
    'km/s': 1e3,
    'AU per day': AU_M / 86400.0,
    'parts of the speed of light': SPEED_OF_LIGHT_M_S,
}
_ABOUT_EARTH = 'relative to the Earth: add the barycentric velocity of the Earth'


@dataclass(frozen=True)
class Doubt:
    """
    A usual mistake that would make a velocity that of the Earth.

    ``mistake`` completes "the velocity is ..." and names the remedy; ``sigma_m_s`` is what it
    changes; ``is_certain`` if no other velocity is likely to look so.
    """

    mistake: str
    sigma_m_s: float
    is_certain: bool


def off_earth_m_s(time_ns: Sequence[int], velocity_m_s: Floats) -> float:
    """Return the largest difference of velocities (k, 3) from those of the Earth at k times."""
    return _range(velocity_m_s - _earth_m_s(time_ns))[1]


def doubt_of(time_ns: Sequence[int], velocity_m_s: Floats) -> Doubt | None:
    """Return the usual mistake that velocities (k, 3) at k times show; None if they show none."""
    earth_m_s = _earth_m_s(time_ns)
    least_m_s, most_m_s = _range(velocity_m_s - earth_m_s)
    slowest_m_s, fastest_m_s = _range(velocity_m_s)
    if fastest_m_s > FASTEST_M_S:
        return Doubt('faster than any spacecraft: state it in m/s', fastest_m_s, is_certain=True)
    is_constant = _range(velocity_m_s - velocity_m_s[0])[1] < _SHOWN_M_S
    orbit_m_s = (
        ESCAPE_M_S if is_constant else _fastest_orbit_m_s(np.asarray(time_ns), velocity_m_s)
    )
    for mistake, right_m_s in _corrected(velocity_m_s, earth_m_s):
        nearest_m_s, farthest_m_s = _range(right_m_s - earth_m_s)
        is_about_earth = mistake == _ABOUT_EARTH
        if farthest_m_s > (orbit_m_s if mistake in _TURNS else ESCAPE_M_S):
            continue
        # One number for all times is that of one of them; an orbit passes it by chance.
        apart_m_s = nearest_m_s if is_constant else farthest_m_s
        is_exact = apart_m_s < _EXACT_M_S and not is_about_earth
        is_certain = (is_exact and least_m_s > _SLOWEST_M_S) or slowest_m_s < _SLOWEST_M_S
        if is_certain or most_m_s > ESCAPE_M_S:
            return Doubt(mistake, _range(right_m_s - velocity_m_s)[1], is_certain)
    return None


def _fastest_orbit_m_s(time_ns: Integers, velocity_m_s: Floats) -> float:
    """
    Return the largest speed about the Earth with the acceleration of velocities (k, 3).

    At the distance at which the Earth has it, that of escape, ``(4 GM a)^(1/4)``.  Large steps are
    of parts of an orbit, and show no acceleration.
    """
    order = np.argsort(time_ns, kind='stable')
    step_s = np.diff(time_ns[order]) / NANOSECONDS_PER_SECOND
    step_m_s = np.linalg.norm(np.diff(velocity_m_s[order], axis=0), axis=1)[step_s > 0]
    if not len(step_m_s) or step_m_s.max() > _SLOWEST_M_S:
        return ESCAPE_M_S
    acceleration_m_s2 = float((step_m_s / step_s[step_s > 0]).max())
    orbit_m_s = math.sqrt(2.0 * math.sqrt(_GM_EARTH * acceleration_m_s2))
    return min(ESCAPE_M_S, _SLOWEST_M_S + orbit_m_s)


def _corrected(velocity_m_s: Floats, earth_m_s: Floats) -> Iterator[tuple[str, Floats]]:
    """Yield mistakes and velocities without them, those nearer to the Earth's first."""
    turned = [
        (mistake, right_m_s)
        for mistake, turn in _TURNS.items()
        for right_m_s in [velocity_m_s @ turn.T]
    ]
    turned.sort(key=lambda one: _range(one[1] - earth_m_s)[1])
    yield from turned
    for unit, size in _UNITS.items():
        in_unit = f'in {unit}: state it in m/s'
        for mistake, turn in {'': np.eye(3), **_TURNS}.items():
            yield (
                (f'{in_unit}; then {mistake}' if mistake else in_unit),
                (size * velocity_m_s @ turn.T),
            )
    # No orbit about the Earth is as slow as 11 m/s, but its number in km/s is.
    size = _UNITS['km/s'] if _range(velocity_m_s)[1] < 1e-3 * ESCAPE_M_S else 1.0
    yield _ABOUT_EARTH, size * velocity_m_s + earth_m_s


def _range(vectors: Floats) -> tuple[float, float]:
    lengths = np.linalg.norm(vectors, axis=-1)
    return float(lengths.min()), float(lengths.max())


def _earth_m_s(time_ns: Sequence[int]) -> Floats:
    return np.array([earth_velocity_c(one) for one in time_ns]) * SPEED_OF_LIGHT_M_S


def velocity_in(direction_icrf: Floats, stars: StarCatalog, rows: Indices, time_ns: int) -> Floats:
    """
    Return the velocity (3,) of the observer in apparent directions (n, 3) of stars, m/s.

    To first order a star is displaced by ``(v - d (d . v)) / c``; the second step is exact to the
    rounding of the directions.  Two stars are enough.
    """
    d = direction_icrf
    normal = len(d) * np.eye(3) - d.T @ d
    velocity_m_s = earth_velocity_c(time_ns) * SPEED_OF_LIGHT_M_S
    for _ in range(2):
        off = d - apparent_directions(stars, time_ns, velocity_m_s, rows)
        across = (off - d * (d * off).sum(axis=1, keepdims=True)).sum(axis=0)
        # By the pseudo-inverse: recordings may have one star twice.
        velocity_m_s = velocity_m_s + SPEED_OF_LIGHT_M_S * (np.linalg.pinv(normal) @ across)
        if _range(velocity_m_s)[1] > FASTEST_M_S:  # directions of other stars, or of none
            break
    return velocity_m_s
