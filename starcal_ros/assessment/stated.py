# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Checks of the statements of an ensemble without stars: velocity, rates, read-out and clock.

Each compares a statement with another known quantity.  A statement that nothing contradicts or
confirms is listed as not checked.  Checks of one value alone are made where it is
read (`pipeline.setup`); those by the stars are `model_checks`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
import itertools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.constants import CLOCKS_SET_NS, NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.estimation.limits import FEWEST
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import Ensemble, StarObservations, StatementCheck
from starcal_ros.sky.astrometry import ESCAPE_M_S
from starcal_ros.sky.catalog import StarCatalog
from starcal_ros.sky.velocity import doubt_of, off_earth_m_s, velocity_in
from starcal_ros.text import significant

_SAMPLED = 8  # images whose velocities are compared, in 25 ms; eight show the turn of an orbit
_UNSTATED_M_S = 1.0  # from the velocity of the Earth, which is taken where none is stated
# Two images that turn at one rate have rates that agree to a fifth.  Their turn shows the rate if
# it exceeds the noise of two coarse attitudes ten times and is less than a full turn.
_EVEN, _LEAST_TURN_RAD, _MOST_TURN_RAD = 0.2, 5e-3, 1.0
_RATE_MISTAKES = {
    'opposite to the turn from image to image: change their sign': -1.0,
    'in degrees per second: send rad/s': math.radians(1.0),
}


def check_statements(
    ensemble: Ensemble, options: CalibrationOptions, catalog: StarCatalog
) -> tuple[StatementCheck, ...]:
    """Return the checks of the statements of an ensemble and of the options that need no stars."""
    images = sorted(ensemble.images, key=lambda image: image.time_ns)
    return (
        *_clock(images),
        *_velocity(images, options, catalog),
        *_readout(images, options),
        *_rates(images),
    )


def with_doubts(ensemble: Ensemble, catalog: StarCatalog) -> Ensemble:
    """Return the ensemble with velocity sigmas as large as a usual mistake that explains them."""
    times_ns, velocity_m_s = _stated_velocities(ensemble.images, catalog)
    doubt = doubt_of(times_ns, velocity_m_s) if times_ns else None
    if doubt is None:
        return ensemble
    sigma_m_s = doubt.sigma_m_s
    images = tuple(
        dataclasses.replace(image, velocity_sigma_m_s=max(image.velocity_sigma_m_s, sigma_m_s))
        if image.velocity_sigma_m_s > 0  # neither exact nor NaN, where it is not known anyway
        else image
        for image in ensemble.images
    )
    return dataclasses.replace(ensemble, images=images)


def _clock(images: Sequence[StarObservations]) -> Iterator[StatementCheck]:
    if images[0].time_ns < CLOCKS_SET_NS:
        yield StatementCheck(
            'clock',
            None,
            f'the images are stamped before {utc_text(CLOCKS_SET_NS)[:10]}: the sigmas exclude the'
            ' wrong places of the stars and of the Earth; stamp them in UTC',
        )


def _velocity(
    images: Sequence[StarObservations], options: CalibrationOptions, catalog: StarCatalog
) -> Iterator[StatementCheck]:
    times_ns, velocity_m_s = _stated_velocities(images, catalog)
    if not times_ns:
        if any(map(_states_velocity, images)):
            yield StatementCheck('velocity', None, 'its catalog is not that of the observations')
        return
    off_m_s = off_earth_m_s(times_ns, velocity_m_s)
    off = f'{off_m_s / 1e3:.1f} km/s from that of the Earth'
    doubt = doubt_of(times_ns, velocity_m_s)
    if doubt is None:
        is_near = off_m_s < ESCAPE_M_S
        why = off if is_near else f'{off}, as of a spacecraft about the Sun'
        yield StatementCheck('velocity', True if is_near else None, f'the velocity is {why}')
    elif doubt.is_certain:
        note = f'the velocity is {doubt.mistake}; if it is right, activate by force'
        yield StatementCheck('velocity', False, note)
    else:
        stated = options.velocity_sigma_m_s
        end = f'{stated:g} m/s are stated' if stated >= 0 else 'if right, state velocity_sigma_m_s'
        note = f'the velocity is {off}, and may be {doubt.mistake}; {end}'
        yield StatementCheck('velocity', None, note)


def _states_velocity(image: StarObservations) -> bool:
    """Return True if the velocity is known to better than that of any orbit about the Earth."""
    return 0.0 < image.velocity_sigma_m_s < ESCAPE_M_S


def _stated_velocities(
    images: Sequence[StarObservations], catalog: StarCatalog
) -> tuple[list[int], Floats]:
    """
    Return stamps and velocities (k, 3) in the directions of some images that state one.

    Images on the ground, of another catalog or with fewer than two stars are left out.
    """
    usable = [
        image
        for image in images
        if image.catalog_digest == catalog.digest
        and image.velocity_sigma_m_s != 0
        and not np.isfinite(image.zenith_icrf).any()
    ]
    times_ns: list[int] = []
    velocities_m_s: list[Floats] = [np.empty((0, 3))]
    is_stated = False
    for image in usable[:: -(-len(usable) // _SAMPLED) or 1]:
        rows, known = catalog.rows_of(image.catalog_id)
        if known.sum() < 2:  # one does not show the velocity along its direction
            continue
        direction_icrf = image.direction_icrf[known]
        times_ns.append(image.time_ns)
        velocities_m_s.append(velocity_in(direction_icrf, catalog, rows[known], image.time_ns))
        is_stated |= _states_velocity(image)
    velocity_m_s = np.vstack(velocities_m_s)
    if times_ns and not is_stated and off_earth_m_s(times_ns, velocity_m_s) < _UNSTATED_M_S:
        return [], np.empty((0, 3))
    return times_ns, velocity_m_s


def _readout(
    images: Sequence[StarObservations], options: CalibrationOptions
) -> Iterator[StatementCheck]:
    if options.shutter != 'rolling':
        return
    steps_s = np.diff([image.time_ns for image in images]) / NANOSECONDS_PER_SECOND
    if not len(steps_s):
        yield StatementCheck('readout_s', None, 'there is one image')
        return
    # Copies of a frame are stamped closer than frames are read.
    step_s, readout_s = float(np.median(steps_s)), abs(options.readout_s)
    is_possible = readout_s <= step_s
    text = f'a read-out of {readout_s:g} s, images {significant(step_s, 3)} s apart'
    remedy = '' if is_possible else ': state readout_s in seconds'
    yield StatementCheck('readout_s', is_possible, text + remedy)


def _rates(images: Sequence[StarObservations]) -> Iterator[StatementCheck]:
    pairs = [
        (one, other)
        for one, other in itertools.pairwise(images)
        if one.star_tracker == other.star_tracker and other.time_ns > one.time_ns
    ]
    rates = np.array([[image.star_tracker_rate_rad_s for image in pair] for pair in pairs])
    if not np.isfinite(rates).any():
        return
    step_s = np.array([other.time_ns - one.time_ns for one, other in pairs])
    step_s = step_s / NANOSECONDS_PER_SECOND
    before, after = (
        Rotation.from_quat([pair[k].icrf_from_star_tracker_xyzw for pair in pairs]) for k in (0, 1)
    )
    turned_rad, stated_rad = (
        (before.inv() * after).as_rotvec(),
        rates.mean(axis=1) * step_s[:, None],
    )
    length_rad = np.linalg.norm(turned_rad, axis=1)
    apart = np.linalg.norm(rates[:, 0] - rates[:, 1], axis=1)
    is_even = apart < _EVEN * np.linalg.norm(rates.mean(axis=1), axis=1)
    is_even &= (length_rad > _LEAST_TURN_RAD) & (length_rad < _MOST_TURN_RAD)

    def explain(factor: float) -> bool:
        off_rad = np.linalg.norm(factor * stated_rad - turned_rad, axis=1)[is_even]
        return bool(np.median(off_rad / length_rad[is_even]) < 2 * _EVEN)

    if is_even.sum() < FEWEST:
        yield StatementCheck('rates', None, 'no even turns from image to image show the rates')
    elif explain(1.0):
        yield StatementCheck('rates', True, 'the rates are those of the turns from image to image')
    else:
        mistakes = [text for text, factor in _RATE_MISTAKES.items() if explain(factor)]
        uneven = 'the turns from image to image are not by the rates'
        failed = f'star_tracker_rate_rad_s is {mistakes[0]}' if mistakes else ''
        yield StatementCheck('rates', False if mistakes else None, failed or uneven)
