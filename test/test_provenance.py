"""Provenance: from what it says a calibration can be repeated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from tiny_campaign import ensemble, values  # type: ignore[import-not-found]

from starcal_ros import solution
from starcal_ros.camera_setup import load_setup, OPTION_CLASSES, Setup
from starcal_ros.options import names_of
from starcal_ros.records import Ensemble


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> Setup:
    return load_setup(values(camera_yaml))


def test_provenance_tells_all_that_went_in(setup: Setup, camera_yaml: Path) -> None:
    first = solution.solve(ensemble(), setup, inputs={'bag': 'abc'}).provenance
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
    second = solution.solve(ensemble(), again, inputs={'bag': 'abc'})
    assert second.provenance == first
    other = Ensemble(ensemble().images[::-1])
    digest = solution.solve(other, setup).provenance['observations_sha256']
    assert digest != first['observations_sha256']
