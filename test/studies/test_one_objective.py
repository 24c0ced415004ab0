# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The prototype of one function that decides: its slope, its variances, and its estimate."""

from __future__ import annotations

import numpy as np
import pytest

from bench.frames import load_set_up
from bench.trials import score
from starcal_ros.arrays import Floats
from starcal_ros.estimation.calibrate import estimate_calibration as of_package
from starcal_ros.estimation.equations import arrow
from starcal_ros.estimation.shared_errors import Groups, pairs_of
from studies.one_objective import __main__ as comparison
from studies.one_objective.centroids import centroid_errors, Residuals
from studies.one_objective.linear import LinearModel
from studies.worlds import campaign


def test_slope_is_the_derivative_of_the_function() -> None:
    made = campaign('rip7_050', 1, images=6)
    setup = load_set_up(made.scenario, shutter='unknown')
    found = of_package(made.ensemble, setup.prior, setup.calibration)
    linear = found.linear
    model = LinearModel(
        arrow(found.sums, linear.problem, linear.state, linear.layout), linear.layout
    )
    theta = model.start() - 1.0
    slope = model.at(theta).slope
    step = 1e-4  # the third derivative is of the order of the number of unknowns, 100
    for k, one in enumerate(np.eye(len(theta)) * step):
        difference = (model.at(theta + one).value - model.at(theta - one).value) / (2.0 * step)
        assert slope[k] == pytest.approx(difference, abs=1e-5)


@pytest.mark.parametrize(
    ('place_px', 'structure_px', 'floor_px'),
    [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.05), (0.04, 0.04, 0.04)],
)
def test_each_variance_is_found_beside_the_others(
    place_px: float, structure_px: float, floor_px: float
) -> None:
    rng = np.random.default_rng(5)
    stars, images, cells = 200, 20, 400
    star = np.tile(np.arange(stars), images)
    cell = rng.integers(0, cells, len(star))
    own_px2 = 10.0 ** rng.uniform(-4.0, -2.0, stars)[star]

    def drawn(size: Floats | float, count: int) -> Floats:
        return np.asarray(size * rng.normal(size=(count, 2)))

    residual_px = drawn(np.sqrt(1.5 * own_px2)[:, None], len(star)) + drawn(floor_px, len(star))
    residual_px += drawn(place_px, stars)[star] + drawn(structure_px, cells)[cell]
    variance_px2 = own_px2 + 3e-3
    residuals = Residuals(
        residual_px=residual_px,
        on_sky_px=residual_px,
        own_px2=own_px2,
        working_px2=variance_px2,
        magnitude=np.zeros(len(star)),
        part=np.ones(len(star)),
        freedom=np.full(len(star), 2.0),
        stars=Groups('stars', star, None),
        cells=Groups('cells', cell, pairs_of(cell, star)),
    )
    found = centroid_errors(residuals, None)
    # 400 displacements determine a variance to a tenth; three sigma.
    assert found.place_px2 == pytest.approx(place_px**2, rel=0.3, abs=1e-5)
    assert found.structure_px2 == pytest.approx(structure_px**2, rel=0.3, abs=3e-5)
    total_px2 = place_px**2 + structure_px**2 + floor_px**2
    assert found.total_px2 == pytest.approx(total_px2, rel=0.2, abs=1e-5)
    # 8,000 displacements determine the scale to 2 %, where no other variance is as large.
    assert found.scale == pytest.approx(1.5, rel=0.06 if total_px2 == 0.0 else 0.2)


@pytest.mark.slow
def test_estimate_is_that_of_the_package_on_a_sound_campaign() -> None:
    made = campaign('plain', 3, images=8)
    setup = load_set_up(made.scenario, shutter='unknown')
    given = made.ensemble, setup, made.scenario.truth, made.true_directions
    scores = []
    for engine in comparison.ENGINES.values():
        with comparison.using(engine) as took_s:
            scores.append(score(*given))
        assert len(took_s) == 1
    for one in scores:
        assert one.termination == 'converged' and one.accepted
        # The engines differ in priors of the finest structure: a tenth of sigma.
        assert one.sigma_arcsec == pytest.approx(scores[0].sigma_arcsec, rel=0.1)
        assert one.shape_arcsec == pytest.approx(scores[0].shape_arcsec, rel=0.1)
