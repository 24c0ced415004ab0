# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Writer of a state folder, for tests that kill its process, and a disk that is full."""

from collections.abc import Iterator
import contextlib
import dataclasses
import functools
import itertools
from multiprocessing.connection import Connection
from pathlib import Path
import resource

import numpy as np
from sample_records import calibration  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.records import Activation, Ensemble, StarObservations
from starcal_ros.ros.archive import Archive


@functools.cache
def images() -> tuple[StarObservations, ...]:
    observed = true_observations(scenario('tiny', seed=7)).images
    # A message cannot tell a rate of zero without a sigma from one that is not known.
    sigma_rad_s = np.full(3, 1e-6)
    return tuple(
        dataclasses.replace(o, star_tracker_rate_sigma_rad_s=sigma_rad_s) for o in observed
    )


def activation(event: int, before: int = 0, number: int = 0) -> Activation:
    """A record whose calibration tells its number by its residual."""
    number = number or event
    changed = dataclasses.replace(calibration(), number=number, residual_rms_px=number / 7)
    return Activation(event, before, changed)


@contextlib.contextmanager
def opened(folder: Path) -> Iterator[Archive]:
    archive = Archive(folder, 'camera')
    try:
        yield archive
    finally:
        archive.close()


def collect(folder: Path, shown: tuple[StarObservations, ...], told: Connection) -> None:
    """In a separate process: save images and calibrations, and report the end of each call."""
    with opened(folder) as archive:
        have, history = archive.read_ensemble(), archive.read_history()
        assert not archive.damage, archive.damage
        for k in itertools.count(len(have.images)):
            image = dataclasses.replace(shown[k % len(shown)], time_ns=k)
            have = Ensemble((*have.images, image), {'no_stars': k})
            history = (*history, activation(archive.last_event + 1))[-3:]
            archive.keep(have, history)
            told.send((k, history[-1].event))


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """No file of this process may grow beyond 100 bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
