# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Weights from the residuals of a round."""

from __future__ import annotations

from four_images import CAMERA, IMAGES, usual  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.shared_errors import observation_groups
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.estimation.unknowns import Assumptions
from starcal_ros.estimation.weights import CentroidVariance, Data, judge, Weighting
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
