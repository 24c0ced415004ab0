# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""An unknown is added by a row, as CONTRIBUTING.md says, from outside of the package."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from worlds import each_image, estimated, of_random_pointings  # type: ignore[import-not-found]

from starcal_ground.planning.plan import prospect, target
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats, Indices
from starcal_ros.assessment.budget import sigma_budget, statements
from starcal_ros.assessment.gate import GateOptions, model_gate
from starcal_ros.assessment.model_checks import model_checks
from starcal_ros.assessment.remedies import remedy_against
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation import unknowns
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.unknowns import Given, Kind, PriorTest, Unknown
from starcal_ros.records import Ensemble, GateCheck, StarObservations

MASS_ICRF = np.array([0.6, 0.8, 0.0])
TRUE_ARCSEC = 2.0  # at 90 degrees five hundred times the Sun's: a few images show it


def row(sigma_arcsec: float) -> Kind:
    """The deflection of light by a mass: stars move away from it."""

    def make(given: Given) -> Unknown:
        def turn(_: Floats, directions: Floats, image: Indices) -> Floats:
            mass = np.einsum('mij,j->im', given.camera_from_icrf, MASS_ICRF)[:, image]
            turns = np.cross(directions, mass, axis=0) / (1.0 - (mass * directions).sum(axis=0))
            return np.asarray(ARCSECOND_RAD * turns[:, None])

        sigma = np.array([sigma_arcsec])
        return Unknown('mass', ('deflection_arcsec',), sigma, np.zeros(1), turn=turn)

    return Kind(
        make,
        cause='light by a mass',
        assumption=lambda layout, *_: f'{layout["mass"].sigma[0]:g} arcsec assumed',
        option=lambda *_: ('deflection_arcsec', 'known', 0.0),
        remedy='point away from the mass',
        tested=PriorTest(('deflection',), 'state the mass', is_added=True),
    )


def deflected(made: Scenario) -> Ensemble:
    """Observations whose catalog has the stars where they were without the mass."""

    def moved(_: int, image: StarObservations) -> dict[str, Floats]:
        e = image.direction_icrf
        cosine = (e @ MASS_ICRF)[:, None]
        e = e - TRUE_ARCSEC * ARCSECOND_RAD * (e * cosine - MASS_ICRF) / (1.0 - cosine)
        return {'direction_icrf': e / np.linalg.norm(e, axis=1, keepdims=True)}

    return each_image(true_observations(made), moved)  # type: ignore[no-any-return]


def solved(monkeypatch: pytest.MonkeyPatch, sigma_arcsec: float) -> Estimate:
    monkeypatch.setitem(unknowns.UNKNOWNS, 'mass', row(sigma_arcsec))
    made = of_random_pointings(3)
    return estimated(made, deflected(made))  # type: ignore[no-any-return]


def test_an_unknown_is_added_by_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is estimated and planned for, its cause is in the budget, and its prior is tested."""
    found, options = solved(monkeypatch, 3.0), CalibrationOptions()
    layout, at = found.linear.layout, found.linear.layout.of(['mass'])
    assert layout.field_at[-1] == layout.count - 1  # the field stays the last
    error = found.posterior.mean[at].item() - TRUE_ARCSEC
    sigma = float(found.posterior.covariance[at, at].item()) ** 0.5
    # By chance a normal error is beyond four sigma in one of 16,000.
    assert abs(error) < 4.0 * sigma < 0.1 * TRUE_ARCSEC
    parts = {part.cause: part for part in sigma_budget(found, options)}
    part, total = parts['light by a mass'], parts['total']
    assert part.assumption == '3 arcsec assumed'
    assert 0.0 < part.map_arcsec < total.map_arcsec
    assert remedy_against(part.cause) == 'point away from the mass'
    # If the whole sigma came from it, none would be left where the option is stated.
    (row,) = statements((total, dataclasses.replace(total, cause=part.cause)), found, options)
    assert (row.option, row.after_arcsec) == ('deflection_arcsec', 0.0)
    assert check_of(found).passed
    wanted, more = target(found, 'deflection_arcsec'), deflected(of_random_pointings(3)).images[:1]
    now, after = prospect(found, more, options).variances([0], wanted.squares)
    assert after < now == pytest.approx(sigma**2)


def test_the_check_of_a_prior_of_an_added_unknown_names_its_remedy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    check = check_of(solved(monkeypatch, 0.1))
    assert check.passed is False
    assert check.note.startswith('the stars add 2.') and check.note.endswith('; state the mass')


def check_of(found: Estimate) -> GateCheck:
    checks = model_gate(model_checks(found), GateOptions())
    (check,) = (check for check in checks if 'deflection' in check.name)
    return check
