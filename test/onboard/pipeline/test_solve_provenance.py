# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Provenance: from what it says a calibration can be repeated."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from sample_records import plain  # type: ignore[import-not-found]
from tiny_campaign import ensemble, values  # type: ignore[import-not-found]

from starcal_ros.formats.messages.record_messages import (
    observations_from_message,
    observations_to_message,
)
from starcal_ros.options import names_of
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import load_setup, OPTION_CLASSES, Setup
from starcal_ros.pipeline.solve import inputs_of, provenance_of
from starcal_ros.records import Ensemble, StarObservations


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> Setup:
    return load_setup(values(camera_yaml))


@pytest.mark.slow
def test_provenance_tells_all_that_went_in(setup: Setup, camera_yaml: Path) -> None:
    first = solve.solve(ensemble(), setup, inputs={'bag': 'abc'}).provenance
    assert first['software'].startswith('starcal ')
    assert first['catalog'] == setup.catalog.digest
    assert first['input bag'] == 'abc'
    prior = json.loads(first['prior'])
    assert prior[:10] == setup.prior.camera.parameters.tolist()
    assert prior[10:] == setup.prior.star_tracker_from_camera_xyzw.tolist()
    # From the options in it the setup can be made again.
    options = json.loads(first['options'])
    assert set(options) == names_of(*OPTION_CLASSES)
    again = load_setup(options)
    second = solve.solve(ensemble(), again, inputs={'bag': 'abc'})
    assert second.provenance == first
    other = Ensemble(ensemble().images[::-1])
    digest = solve.solve(other, setup).provenance['observations_sha256']
    assert digest != first['observations_sha256']


def digest_of(images: list[StarObservations], setup: Setup) -> str:
    return provenance_of(setup, Ensemble(tuple(images)), {})['observations_sha256']


def test_the_digest_is_of_all_that_a_calibration_is_made_from(setup: Setup) -> None:
    images = list(ensemble().images)
    digest = digest_of(images, setup)
    first = images[0]
    other = np.roll(first.icrf_from_star_tracker_xyzw, 1)
    for changed in (
        {'time_ns': first.time_ns + 1},
        {'icrf_from_star_tracker_xyzw': other},
        {'direction_icrf': -first.direction_icrf},
        {'measured_px': np.nextafter(first.measured_px, np.inf)},
        {'covariance_px2': 2.0 * first.covariance_px2},
        {'catalog_id': first.catalog_id + 1},
        {'temperature_degc': 20.0},
    ):
        assert digest_of([dataclasses.replace(first, **changed), *images[1:]], setup) != digest
    assert digest_of([dataclasses.replace(first, psf_sigma_px=3.0), *images[1:]], setup) == digest


def test_recorded_observations_have_the_digest_of_the_images(setup: Setup) -> None:
    """What the node is sent and what the tool reads of a bag: the same bytes."""
    images = list(ensemble().images)
    sent = [
        observations_from_message(observations_to_message(one, 'camera', plain)) for one in images
    ]
    assert digest_of(sent, setup) == digest_of(images, setup)


def test_digests_can_be_stopped(tmp_path: Path) -> None:
    """A file of three blocks, stopped after the first."""
    file = tmp_path / 'bag'
    file.write_bytes(bytes(3 << 20))
    asked = iter([False, True])
    stopped = inputs_of([file], lambda: next(asked))
    assert stopped[str(file)] == f'sha256:{hashlib.sha256(bytes(1 << 20)).hexdigest()}'
    assert inputs_of([file])[str(file)] == f'sha256:{hashlib.sha256(bytes(3 << 20)).hexdigest()}'
