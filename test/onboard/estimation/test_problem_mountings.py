# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Several star trackers: the camera aligned to each, with a true covariance."""

from collections.abc import Sequence
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds import each_image, estimated, of_random_pointings  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario, scene
from starcal_ros.arrays import Floats
from starcal_ros.assessment.gate import GateOptions, model_gate, star_tracker_gate
from starcal_ros.assessment.model_checks import model_checks
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.records import Ensemble, StarObservations, StarTrackerAlignment

SIGMA_ARCSEC = (5.0, 5.0, 30.0)
# Far from each other, as optical heads are; the axes of their sigmas with them.
ASSUMED = [
    Rotation.identity(),
    *(Rotation.from_euler('xz', a, True) for a in ([90, 30], [40, 120])),
]
WRONG_ARCSEC = np.array([[0.0, 0.0, 0.0], [200.0, -150.0, 100.0], [-300.0, 80.0, 250.0]])
MOUNTED = [
    assumed * Rotation.from_rotvec(wrong * ARCSECOND_RAD)
    for assumed, wrong in zip(ASSUMED, WRONG_ARCSEC, strict=True)
]


def campaign(
    seed: int,
    heads: Sequence[int],
    drift_arcsec_per_image: Floats | None = None,
    slow_arcsec: float = 0.0,
    wrong: Rotation | None = None,
    noise: float = 1.0,
) -> tuple[Scenario, Ensemble]:
    """
    A campaign in which each image has the attitude of the star tracker that is named.

    The second one drifts, and its mounting is assumed wrong by a turn; each has an error that
    stays over the campaign, of the size of its noise at a mean of ``slow_arcsec``.  ``noise`` is a
    factor of the errors but the drift.
    """
    given = of_random_pointings(seed, images=len(heads))
    # A hundred stars place an image ten times better than its star tracker does.
    given = dataclasses.replace(given, star_tracker_sigma_arcsec=SIGMA_ARCSEC, magnitude_limit=6.7)
    rng = np.random.default_rng([seed, 5])
    share = slow_arcsec / float(np.mean(SIGMA_ARCSEC))
    slow = share * np.array(SIGMA_ARCSEC) * np.random.default_rng([seed, 6]).normal(size=(3, 3))
    assumed = [*ASSUMED[:1], ASSUMED[1] * (wrong or Rotation.identity()), *ASSUMED[2:]]
    first_from_camera = given.truth.star_tracker_from_camera

    def reported(index: int, _: StarObservations) -> dict[str, Any]:
        head = heads[index]
        camera_from_icrf = Rotation.from_matrix(scene(given, index).camera_from_icrf)
        true = (first_from_camera * camera_from_icrf).inv() * MOUNTED[head]
        error_arcsec = noise * (slow[head] + np.array(SIGMA_ARCSEC) * rng.normal(size=3))
        if drift_arcsec_per_image is not None and head == 1:
            error_arcsec += index * drift_arcsec_per_image
        measured = true * Rotation.from_rotvec(error_arcsec * ARCSECOND_RAD)
        return {
            'icrf_from_star_tracker_xyzw': (measured * assumed[head].inv()).as_quat(),
            'star_tracker': '' if head == 0 else f'head_{head}',
            'first_from_star_tracker_xyzw': assumed[head].as_quat(),
        }

    return given, each_image(true_observations(given), reported)


def error_rad(given: Scenario, found: StarTrackerAlignment, head: int) -> Floats:
    """Passive small rotation of the camera frame from the true alignment to the one found."""
    first_from_camera = given.truth.star_tracker_from_camera
    true = MOUNTED[head].inv() * first_from_camera
    return np.asarray(
        (true.inv() * Rotation.from_quat(found.star_tracker_from_camera_xyzw)).as_rotvec()
    )


@pytest.mark.parametrize('method', ['hierarchical', 'single'])
def test_each_alignment_is_found(method: str) -> None:
    # The method single takes the star trackers as perfect.
    noise = 1.0 if method == 'hierarchical' else 0.0
    given, ensemble = campaign(1, [0, 1, 2] * 6, noise=noise)
    if not noise:
        given = dataclasses.replace(given, star_tracker_sigma_arcsec=(1e-3,) * 3)
    trackers = estimated(given, ensemble, method=method).star_trackers
    assert [(one.frame, one.images) for one in trackers] == [('', 6), ('head_1', 6), ('head_2', 6)]
    for head, one in enumerate(trackers):
        error, C = error_rad(given, one, head), one.alignment_covariance_rad2
        # Six images of 5, 5 and 30 arcsec, slow errors that may be as large, and the principal
        # point, which trades with all alignments: some 45 arcsec; mountings are wrong by 200 to
        # 400.
        assert np.sqrt(np.trace(C)) < 60 * ARCSECOND_RAD
        # 0.1 % of true ones exceed it, of each of three.
        assert error @ np.linalg.solve(C, error) < chi2.isf(1e-3, 3)
        # The mounting is the alignment to the one against that to the other.
        first = Rotation.from_quat(trackers[0].star_tracker_from_camera_xyzw)
        own = Rotation.from_quat(one.star_tracker_from_camera_xyzw)
        mounting = Rotation.from_quat(one.first_from_star_tracker_xyzw)
        assert (first * (mounting * own).inv()).magnitude() < 1e-12


@pytest.mark.slow
def test_the_covariance_of_alignments_and_mountings_is_true() -> None:
    squared, of_mountings = [], []
    for seed in range(1, 17):
        given, ensemble = campaign(seed, [0, 1, 2] * 4, slow_arcsec=10.0)
        trackers = estimated(given, ensemble, star_tracker_slow_arcsec=10.0).star_trackers
        errors = [error_rad(given, one, head) for head, one in enumerate(trackers)]
        for one, error in zip(trackers, errors, strict=True):
            squared.append(error @ np.linalg.solve(one.alignment_covariance_rad2, error))
        for one, error in zip(trackers[1:], errors[1:], strict=True):
            apart = error - errors[0]
            of_mountings.append(apart @ np.linalg.solve(one.mounting_covariance_rad2, apart))
    # Sixteen campaigns of three correlated alignments: as at least 16 independent draws of chi^2
    # of 3.  The sigma of the star tracker is estimated from 12 images, which makes the tails
    # longer: the interval of all but one in 500 of those means.
    low, high = chi2.ppf([0.001, 0.999], 3 * 16) / 16
    assert low < np.mean(squared) < high and low < np.mean(of_mountings) < high


def test_a_star_tracker_that_drops_out_costs_nothing() -> None:
    """The second star tracker takes over: shape and alignment to it are as good as before."""
    given, both = campaign(2, [0] * 6 + [1] * 6)
    _, first = campaign(2, [0] * 12)
    found, alone = estimated(given, both), estimated(given, first)
    own = found.linear.problem.camera_count
    shape, before = (np.sqrt(np.diag(one.covariance))[:own] for one in (found, alone))
    known = before > 0
    np.testing.assert_allclose(shape[known], before[known], rtol=0.05)  # of the attitudes alone
    # Half of the images each: sqrt(2) of the noise of the star tracker.
    for one in found.star_trackers:
        ratio = np.trace(one.alignment_covariance_rad2) / np.trace(alone.covariance[own:, own:])
        assert ratio < 2.6


def test_without_images_of_the_first_its_alignment_has_the_sigma_of_the_mounting() -> None:
    given, ensemble = campaign(3, [1] * 8)
    found = estimated(given, ensemble, star_tracker_mounting_sigma_arcsec=500.0)
    first, second = found.star_trackers
    assert (first.images, second.images) == (0, 8)
    assert np.sqrt(np.trace(second.alignment_covariance_rad2)) < 60 * ARCSECOND_RAD  # as above
    sigma_arcsec = np.sqrt(np.diag(found.covariance)[-3:]) / ARCSECOND_RAD
    np.testing.assert_allclose(sigma_arcsec, 500.0, rtol=0.01)


@pytest.mark.parametrize('jump_deg', [0.0, 0.5])
def test_a_star_tracker_that_drifts_is_named_and_loses_no_image(jump_deg: float) -> None:
    """240 arcsec, 48 sigma of an image: none is a misfit; one that jumps is, hiding no drift."""
    given, ensemble = campaign(4, [0, 1, 2] * 12, np.array([240.0 / 36, 0.0, 0.0]))
    images = list(ensemble.images)
    attitude = Rotation.from_quat(images[31].icrf_from_star_tracker_xyzw)
    jumped = attitude * Rotation.from_rotvec([0.0, math.radians(jump_deg), 0.0])
    images[31] = dataclasses.replace(images[31], icrf_from_star_tracker_xyzw=jumped.as_quat())
    found = estimated(given, Ensemble(tuple(images)))
    assert found.termination == 'converged'
    assert np.flatnonzero(found.misfit_image).tolist() == [31] * bool(jump_deg)
    first, second, third = found.star_trackers
    for sound in (first, third):
        assert sound.drift_p_value > 1e-4
    assert second.drift_p_value < 1e-9
    assert second.drift_arcsec == pytest.approx(240.0, abs=40.0)  # noise of 30 arcsec about z
    # Its images are the second to the 35th of 36, a minute apart: 220 arcsec of the 240.
    hours = second.drift_arcsec / np.linalg.norm(second.drift_arcsec_per_hour)
    assert hours == pytest.approx(33 / 60)
    about_x, *about_yz = hours * np.array(second.drift_arcsec_per_hour)
    assert about_x == pytest.approx(220.0, abs=20.0) and np.abs(about_yz).max() < 40.0
    (refused,) = [
        one for one in star_tracker_gate(found.star_trackers, GateOptions()) if not one.passed
    ]
    assert refused.option == 'max_star_tracker_drift_arcsec' and 'head_1' in refused.name
    # The alignment to it is anything that it was in the campaign: 240 / sqrt(12).
    sigma_arcsec = np.sqrt(np.trace(second.alignment_covariance_rad2)) / ARCSECOND_RAD
    assert sigma_arcsec > 240.0 / np.sqrt(12.0)


@pytest.mark.parametrize(
    ('heads', 'axis', 'degrees'),
    [
        ([0, 1] * 6, 'x', 1.0),
        ([0, 1] * 6, 'y', 170.0),
        ([0, 1, 2] * 6, 'z', 90.0),
        ([0, 1, 1, 1] * 4, 'x', 20.0),
    ],
)
def test_a_wrong_mounting_costs_no_image_and_is_named(heads, axis, degrees) -> None:
    wrong = Rotation.from_euler(axis, degrees, degrees=True)
    given, ensemble = campaign(3, heads, wrong=wrong)
    found = estimated(given, ensemble)
    assert found.termination == 'converged'
    assert found.kept.all() and not found.misfit_image.any()
    for head, one in enumerate(found.star_trackers):
        error, C = error_rad(given, one, head), one.alignment_covariance_rad2
        # The prior of 300 arcsec pulls by the share of the information that is its.
        pull = np.trace(C) / (300.0 * ARCSECOND_RAD) ** 2 * np.radians(degrees)
        assert np.linalg.norm(error) < 5 * np.sqrt(np.trace(C)) + pull
    checks = model_checks(found)
    off = [term for term in checks.held if term.name.startswith('mounting of head_1')]
    assert len(off) == 3
    turn_deg = np.linalg.norm([term.estimated for term in off])
    # The other mountings are wrong by 270 arcsec too, and the pull is as above.
    assert turn_deg == pytest.approx(degrees, rel=0.04, abs=0.2)
    assert max(term.significance for term in off) > 5.0
    refused = [one for one in model_gate(checks, GateOptions()) if not one.passed]
    # At 170 degrees the prior pulls the alignment too, and other mountings with it.
    assert refused and 'mounting of head_1' in max(refused, key=lambda one: one.found).name


def test_one_rotation_for_each_image_has_no_place_for_several() -> None:
    given, ensemble = campaign(5, [0, 1] * 4)
    with pytest.raises(OptionError, match='^method: per_image'):
        estimated(given, ensemble, method='per_image')
