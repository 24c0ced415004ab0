# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The smallest lens model that describes the stars, by simulated lenses and a real camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from worlds import honesty, of_random_pointings  # type: ignore[import-not-found]

from starcal_ground.bags.reader import read_observations
from starcal_ground.parameter_files import NODES, read_parameter_file
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ground.smallest_lens import estimate_with_smallest_lens
from starcal_ros.camera.projection import convert
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import Ensemble


def with_lens(model: str, **coefficients: float) -> Scenario:
    """A campaign of a camera of a lens model, the prior of plumb_bob."""
    given: Scenario = of_random_pointings(5, images=6)
    camera, _ = convert(given.truth.camera, model)
    truth = dataclasses.replace(given.truth, camera=camera.replace(**coefficients))
    return dataclasses.replace(given, truth=truth)


KB97 = Path(__file__).parents[4] / 'shared/realsky/lco_kb97_observations'


@pytest.mark.slow
def test_a_lens_that_the_stars_do_not_show_loses_without_a_traceback() -> None:
    if not KB97.is_dir():
        pytest.skip('lco_kb97_observations is not on this machine')
    stated = read_parameter_file(KB97 / 'params.yaml', NODES)
    stated |= {name: str(KB97 / str(stated[name])) for name in ('camera_info_url', 'catalog')}
    setup = load_setup(stated)
    ensemble = Ensemble()
    for record in read_observations([KB97 / 'observations.mcap'], '/observations'):
        ensemble = ensemble.add(record)
    found = estimate_with_smallest_lens(ensemble, setup.prior, setup.calibration)
    camera = found.geometry.camera
    assert camera.intrinsics[0] == pytest.approx(180540.9, rel=0.01)
    # In half a degree the stars show no other coefficients: k4 was -7e14 in an equidistant.
    assert camera.model == setup.prior.camera.model


@pytest.mark.slow
@pytest.mark.parametrize(
    ('model', 'coefficients', 'chosen'),
    [
        ('plumb_bob', {}, ('plumb_bob',)),
        # 3 px in a corner of this lens, 0.22 from its axis.
        ('thin_prism', {'s1': 0.02, 's2': 0.3}, ('plumb_bob', 'thin_prism', 'tilted')),
        # To first order a small tilt is a principal point and a decentring.
        (
            'tilted',
            {'tau_x': 0.03, 'tau_y': -0.02},
            ('plumb_bob', 'rational_polynomial', 'thin_prism', 'tilted'),
        ),
    ],
)
def test_the_smallest_model_that_leaves_no_field_is_chosen(
    model: str, coefficients: dict[str, float], chosen: tuple[str, ...]
) -> None:
    given = with_lens(model, **coefficients)
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec, velocity_sigma_m_s=10.0
    )
    found = estimate_with_smallest_lens(true_observations(given), given.prior, options)
    assert found.geometry.camera.model in chosen
    # Where no model of those that converge is free of a field, the field is in the estimate.
    assert found.termination == 'converged'
    assert honesty(given, found, np.zeros_like)[0] < 2.0
