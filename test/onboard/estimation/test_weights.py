# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Weights from the residuals of a round."""

from __future__ import annotations

from four_images import CAMERA, IMAGES, usual  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.shared_errors import observation_groups
from starcal_ros.estimation.tracker_errors import Attitudes, Rates, TrackerErrors
from starcal_ros.estimation.unknowns import Assumptions
from starcal_ros.estimation.weights import CentroidVariance, damped, Data, judge, Weighting
from starcal_ros.records import CameraGeometry


@pytest.mark.parametrize(
    ('off_px', 'words'), [(np.nan, 'no star has an image'), (1e3, 'three stars that fit')]
)
def test_residuals_that_no_star_is_left_of_say_so(off_px: float, words: str) -> None:
    table = usual()[0].table
    n = len(table)
    data = Data(
        table,
        np.arange(IMAGES),
        np.ones(3),
        CameraGeometry(CAMERA, np.array([0.0, 0.0, 0.0, 1.0])),
        CalibrationOptions(variance_components=False),
        Rates(np.zeros((IMAGES, 3)), np.zeros((IMAGES, 3, 3))),
        Assumptions(0.0, (0.0, 0.0), 0.0),
        observation_groups(table.measured_px, table.star, CAMERA.width),
    )
    before = Weighting(CentroidVariance(1.0, 0.0), (), np.ones(n, bool), None)
    from_sky = np.tile(np.eye(2), (n, 1, 1))
    off = off_px * np.random.default_rng(1).normal(size=(n, 2))
    with pytest.raises(NotObservable, match=words):
        judge(data, from_sky, off, np.full(n, 2.0), before, None)


def test_weights_go_the_share_of_a_step_towards_the_next() -> None:
    """As a step may overshoot, so may what residuals and weights ask of each other."""
    kept = np.ones(4, bool)

    def judged(scale: float, factors: tuple[float, ...], working: float) -> Weighting:
        noise = TrackerErrors(1.0, 0.0, np.eye(1), np.zeros(4, np.int64), working, 0.0, '', 1.0)
        seen = np.ones(IMAGES, bool)
        error, covariance = np.zeros((IMAGES, 3)), np.zeros((IMAGES, 3, 3))
        attitudes = Attitudes(error, covariance, seen, ~seen, (noise,))
        magnitudes = tuple(float(k) for k in range(len(factors)))
        variance = CentroidVariance(scale, 1e-3 * scale, magnitudes, factors)
        return Weighting(variance, (), kept, attitudes)

    before, after = judged(1.0, (1.0, 2.0), 16.0), judged(2.0, (3.0, 1.0), 12.0)
    found = damped(before, after, 0.25)
    assert found.attitudes is not None
    assert found.variance == CentroidVariance(1.25, 1.25e-3, (0.0, 1.0), (1.5, 1.75))
    assert found.attitudes.trackers[0].working == 15.0
    assert damped(before, after, 1.0) is after
    other = judged(2.0, (3.0,), 12.0)  # of other stars: nothing to go from
    assert damped(before, other, 0.25) is other
    first = Weighting(before.variance, (), kept, None)
    assert damped(first, after, 0.25) is after
