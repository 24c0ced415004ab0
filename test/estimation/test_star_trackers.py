# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Several star trackers: the camera aligned to each, with a true covariance."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses

import numpy as np
import pytest
from random_pointings import estimated, of_random_pointings  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from starcal_ros.arrays import Floats
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.records import Ensemble, StarObservations, StarTrackerAlignment
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import Scenario, scene

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
    seed: int, heads: Sequence[int], drift_arcsec_per_image: Floats | None = None
) -> tuple[Scenario, Ensemble]:
    """A campaign in which each image has the attitude of the star tracker that is named."""
    given = of_random_pointings(seed, images=len(heads))
    given = dataclasses.replace(given, star_tracker_sigma_arcsec=SIGMA_ARCSEC)
    rng = np.random.default_rng([seed, 5])
    first_from_camera = Rotation.from_quat(given.truth.star_tracker_from_camera_xyzw)
    images = []
    for index, (image, head) in enumerate(
        zip(true_observations(given).images, heads, strict=True)
    ):
        camera_from_icrf = Rotation.from_matrix(scene(given, index).camera_from_icrf)
        true = (first_from_camera * camera_from_icrf).inv() * MOUNTED[head]
        error_arcsec = np.array(SIGMA_ARCSEC) * rng.normal(size=3)
        if drift_arcsec_per_image is not None and head == 1:
            error_arcsec += index * drift_arcsec_per_image
        measured = true * Rotation.from_rotvec(error_arcsec * ARCSECOND_RAD)
        images.append(
            dataclasses.replace(
                image,
                icrf_from_star_tracker_xyzw=(measured * ASSUMED[head].inv()).as_quat(),
                star_tracker='' if head == 0 else f'head_{head}',
                first_from_star_tracker_xyzw=ASSUMED[head].as_quat(),
            )
        )
    return given, Ensemble(tuple(images))


def error_rad(given: Scenario, found: StarTrackerAlignment, head: int) -> Floats:
    """Passive small rotation of the camera frame from the true alignment to the one found."""
    first_from_camera = Rotation.from_quat(given.truth.star_tracker_from_camera_xyzw)
    true = MOUNTED[head].inv() * first_from_camera
    return np.asarray(
        (true.inv() * Rotation.from_quat(found.star_tracker_from_camera_xyzw)).as_rotvec()
    )


@pytest.mark.parametrize('method', ['hierarchical', 'single'])
def test_each_alignment_is_found(method: str) -> None:
    given, ensemble = campaign(1, [0, 1, 2] * 6)
    if method == 'single':  # which takes the star trackers as perfect
        ensemble = dataclasses.replace(
            ensemble,
            images=tuple(
                _without_noise(given, k, image) for k, image in enumerate(ensemble.images)
            ),
        )
    trackers = estimated(given, ensemble, method=method).star_trackers
    assert [(one.frame, one.images) for one in trackers] == [('', 6), ('head_1', 6), ('head_2', 6)]
    for head, one in enumerate(trackers):
        error, C = error_rad(given, one, head), one.alignment_covariance_rad2
        # Six images of 5, 5 and 30 arcsec, and the principal point, which trades with all
        # alignments: some 20 arcsec; mountings are wrong by 200 to 400.
        assert np.sqrt(np.trace(C)) < 40 * ARCSECOND_RAD
        # 0.1 % of true ones exceed it, of each of three.
        assert error @ np.linalg.solve(C, error) < chi2.isf(1e-3, 3)
        # The mounting is the alignment to the one against that to the other.
        first = Rotation.from_quat(trackers[0].star_tracker_from_camera_xyzw)
        own = Rotation.from_quat(one.star_tracker_from_camera_xyzw)
        mounting = Rotation.from_quat(one.first_from_star_tracker_xyzw)
        assert (first * (mounting * own).inv()).magnitude() < 1e-12


def _without_noise(given: Scenario, index: int, image: StarObservations) -> StarObservations:
    head = 0 if not image.star_tracker else int(image.star_tracker[-1])
    first_from_camera = Rotation.from_quat(given.truth.star_tracker_from_camera_xyzw)
    camera_from_icrf = Rotation.from_matrix(scene(given, index).camera_from_icrf)
    true = (first_from_camera * camera_from_icrf).inv() * MOUNTED[head] * ASSUMED[head].inv()
    return dataclasses.replace(image, icrf_from_star_tracker_xyzw=true.as_quat())


def test_the_covariance_of_alignments_and_mountings_is_true() -> None:
    squared, of_mountings = [], []
    for seed in range(1, 31):
        given, ensemble = campaign(seed, [0, 1, 2] * 4)
        trackers = estimated(given, ensemble).star_trackers
        errors = [error_rad(given, one, head) for head, one in enumerate(trackers)]
        for one, error in zip(trackers, errors, strict=True):
            squared.append(error @ np.linalg.solve(one.alignment_covariance_rad2, error))
        for one, error in zip(trackers[1:], errors[1:], strict=True):
            apart = error - errors[0]
            of_mountings.append(apart @ np.linalg.solve(one.mounting_covariance_rad2, apart))
    # Thirty campaigns of three correlated alignments: as at least 30 independent draws of chi^2 of
    # 3, whose mean scatters by 0.45.  The sigma of the star tracker is estimated from 12 images,
    # which makes the tails longer: four sigma.
    assert abs(np.mean(squared) - 3.0) < 1.8
    assert abs(np.mean(of_mountings) - 3.0) < 1.8


def test_a_star_tracker_that_drops_out_costs_nothing() -> None:
    """The second star tracker takes over: shape and alignment to it are as good as before."""
    given, both = campaign(2, [0] * 6 + [1] * 6)
    _, first = campaign(2, [0] * 12)
    found, alone = estimated(given, both), estimated(given, first)
    own = found.problem.camera_count
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
    assert np.sqrt(np.trace(second.alignment_covariance_rad2)) < 40 * ARCSECOND_RAD
    sigma_arcsec = np.sqrt(np.diag(found.covariance)[-3:]) / ARCSECOND_RAD
    np.testing.assert_allclose(sigma_arcsec, 500.0, rtol=0.01)


def test_a_star_tracker_that_drifts_is_named() -> None:
    given, ensemble = campaign(4, [0, 1] * 10, np.array([6.0, 0.0, 0.0]))
    first, second = estimated(given, ensemble).star_trackers
    assert second.drift_p_value < 1e-4 < first.drift_p_value
    assert second.drift_arcsec > 3 * first.drift_arcsec


def test_one_rotation_for_each_image_has_no_place_for_several() -> None:
    given, ensemble = campaign(5, [0, 1] * 4)
    with pytest.raises(OptionError, match='^method: per_image'):
        estimated(given, ensemble, method='per_image')
