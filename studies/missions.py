# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Random missions: a prior of all that the documents promise, sound or departing from the model.

Mission k of a seed is the same for any number of them; a sound one lacks the departures alone.
"""

from __future__ import annotations

import dataclasses
from functools import partial
import math

import numpy as np
from numpy.random import Generator

from starcal_ros.sky.catalog import load_catalog
from studies import worlds
from studies.worlds import World

_MISSIONS = 92  # random stream (seed, purpose, mission)
_DEEPEST = 9.0  # magnitude
_FEWEST = 200  # stars in all


def drawn(seed: int, mission: int, sound: bool) -> World:
    """Mission of the prior; a sound one has the same camera, pointings and stars."""
    rng = np.random.default_rng([seed, _MISSIONS, mission])
    field_deg = _log(rng, 6.0, 100.0)
    lenses = ['plumb_bob', 'plumb_bob', 'rational_polynomial', 'equidistant']
    faint_px, rate = _log(rng, 0.12, 0.5), _log(rng, 1e-3, 0.3)
    # Catalog and light so that the image has so many stars, the faintest with this sigma.
    magnitude = np.sort(load_catalog(None, _DEEPEST).magnitude)
    magnitude = magnitude[magnitude > worlds.SATURATED_MAGNITUDE]
    share = math.radians(field_deg) ** 2 * 0.79 / (4.0 * math.pi)
    faintest = int(min(max(_log(rng, 6.0, 250.0) / share, 40.0), len(magnitude) - 1))
    stars = share * faintest
    psf2, noise2 = worlds.PSF_SIGMA_PX**2, worlds.NOISE_ELECTRONS**2
    electrons = psf2 + math.sqrt(psf2**2 + 4.0 * faint_px**2 * psf2 * noise2)
    electrons /= 2.0 * faint_px**2
    limit = float(magnitude[faintest])
    least = max(3, math.ceil(_FEWEST / stars))
    world = World(
        images=max(round(_log(rng, 3.0, 200.0)), least),
        pointing=str(rng.choice(['sky', 'strip', 'fields4', 'sky', 'side'])),
        model=str(rng.choice(lenses[: 2 if field_deg < 30.0 else 3 if field_deg < 50.0 else 4])),
        field_deg=field_deg,
        corner=float(rng.choice([-1.0, -1.0, 1.0])) * _log(rng, 5e-4, 0.03),
        shutter=str(rng.choice(['global', 'unknown'])),
        magnitude_limit=limit,
        zero_point_dn=electrons * 10.0 ** (0.4 * limit) / worlds.ELECTRONS_PER_DN,
        bright_px=_log(rng, 0.01, 0.1),
        tracker_arcsec=_log(rng, 2.0, 60.0),
        rate_deg_s=_with(rng, 0.5, rate),
        stamp_s=0.005 * rng.normal(),
    )
    # Without a velocity the mission is in a low orbit; these pointings are about a velocity.
    lacks_velocity = world.pointing == 'side' or rng.random() < 0.3
    world = dataclasses.replace(world, velocity_m_s=7600.0 if lacks_velocity else 0.0)
    lens = partial(worlds.ripple, _log(rng, 0.003, 0.3), _log(rng, 2.0, 20.0))
    tilt = partial(worlds.tilt, _log(rng, 0.05, 1.0))
    departures = {
        'lens': [worlds.no_departure, worlds.no_departure, lens, tilt][rng.integers(4)],
        'breathing': _with(rng, 0.4, _log(rng, 2e-6, 1e-4)),
        'star_arcsec': _with(rng, 0.5, _log(rng, 0.02, 0.3)),
        'blend': _with(rng, 0.3, _log(rng, 0.1, 0.5)),
        'outlier_fraction': _with(rng, 0.5, rng.uniform(0.0, 0.03)),
        'claim': _with(rng, 0.4, _log(rng, 0.6, 1.6), 1.0),
        'tracker_claim': _with(rng, 0.4, _log(rng, 0.7, 1.5), 1.0),
        'wander_arcsec': _with(rng, 0.3, world.tracker_arcsec * rng.uniform()),
        'smooth_arcsec': _with(rng, 0.3, world.tracker_arcsec * rng.uniform()),
        'tracker_hz': _with(rng, 0.4, float(rng.choice([1.0, 2.0, 4.0, 10.0]))),
        'row_s': _with(rng, 0.5, 2e-5 * rng.normal()) if world.shutter == 'unknown' else 0.0,
        # Half of the trackers give a stream, and half the two samples about each image.
        'tracker_samples': int(_with(rng, 0.5, 2)),
    }
    return world if sound else dataclasses.replace(world, **departures)  # type: ignore[arg-type]


def _log(rng: Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _with(rng: Generator, probability: float, value: float, otherwise: float = 0.0) -> float:
    return float(value) if rng.random() < probability else otherwise
