# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Frames with lost lines are refused; frames with a wrong prior are not."""

from __future__ import annotations

import dataclasses
import functools
import re

import numpy as np
import pytest
from sample_sky import exposure_of, started  # type: ignore[import-not-found]

from starcal_ground.simulation.scenario import scenario
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.match_checks import find_line_loss
from starcal_ros.identification.star_finder import Exposure, observe_stars, StarSearch
from starcal_ros.identification.tracking import track_stars
from starcal_ros.records import CameraGeometry, Image
from starcal_ros.sky.catalog import load_catalog

SCENARIO = scenario('tiny', seed=31)
PRIOR = SCENARIO.prior
SEARCH = StarSearch(load_catalog(None, 9.0))
SHAPE = (PRIOR.camera.height, PRIOR.camera.width)


@functools.cache
def exposure(index: int) -> Exposure:
    _, exposed = exposure_of(SCENARIO, index)
    return exposed  # type: ignore[no-any-return]


def with_lost_rows(index: int, row: int, lost: int) -> Exposure:
    """A frame with lost rows: all rows below are shifted up."""
    image = exposure(index).image
    pixels = image.pixels.copy()
    pixels[row:-lost] = image.pixels[row + lost :]
    return dataclasses.replace(exposure(index), image=Image(image.time_ns, pixels))


# 1 % of the focal length and 0.08 of k1: 6 px in a corner.
WRONG = CameraGeometry(
    PRIOR.camera.replace(
        fx=1.01 * PRIOR.camera.intrinsics[0],
        fy=1.01 * PRIOR.camera.intrinsics[2],
        k1=PRIOR.camera.distortion[0] + 0.08,
    ),
    PRIOR.star_tracker_from_camera_xyzw,
)
priors = pytest.mark.parametrize('prior', [PRIOR, WRONG], ids=['prior', 'wrong prior'])


@priors
@pytest.mark.parametrize('index', range(10))
def test_an_intact_frame_is_accepted(prior: CameraGeometry, index: int) -> None:
    assert not observe_stars(exposure(index), prior, SEARCH)[0].refusal


@priors
@pytest.mark.parametrize(('row', 'lost'), [(100, 2), (100, 3), (256, 1), (256, 3), (380, 2)])
def test_lost_rows_are_found(prior: CameraGeometry, row: int, lost: int) -> None:
    with pytest.raises(ImageRefused, match='incomplete: stars below row') as refused:
        observe_stars(with_lost_rows(0, row, lost), prior, SEARCH)
    row_found, down_px = re.findall(r'row (\d+) .*, ([-+.\d]+)\)', refused.value.detail)[0]
    assert abs(int(row_found) - row) < 40  # a tenth of the rows holds a dozen stars
    assert float(down_px) == pytest.approx(-lost, abs=0.3)  # the smooth part takes some


@pytest.mark.parametrize('lost', [1, 2, 3])
def test_lost_rows_are_found_while_tracking(lost: int) -> None:
    _, known = started(exposure(0), PRIOR, SEARCH)
    assert not track_stars(exposure(1), known, SEARCH)[0].refusal
    with pytest.raises(ImageRefused, match='incomplete'):
        track_stars(with_lost_rows(1, 256, lost), known, SEARCH)


def places(n: int, seed: int = 1) -> np.ndarray:
    return np.asarray(np.random.default_rng(seed).uniform([0, 0], [SHAPE[1], SHAPE[0]], (n, 2)))


@pytest.mark.parametrize('n', [0, 1, 19, 20, 60, 151, 400])
def test_noise_alone_makes_no_tear(n: int) -> None:
    rng = np.random.default_rng(2)
    xy = places(n)
    for _ in range(50):
        sigma = 10 ** rng.uniform(-2, -0.5, n)
        assert (
            find_line_loss(xy, xy + sigma[:, None] * rng.normal(size=(n, 2)), sigma, SHAPE) is None
        )


def test_wrong_stars_on_one_side_make_no_tear() -> None:
    rng = np.random.default_rng(3)
    xy, sigma = places(150), np.full(150, 0.1)
    for _ in range(20):
        measured = xy + 0.1 * rng.normal(size=(150, 2))
        below = np.flatnonzero(xy[:, 1] > 400)
        wrong = rng.choice(below, len(below) // 3, replace=False)
        measured[wrong] += rng.uniform(0.5, 3.0, (len(wrong), 2))
        assert find_line_loss(xy, measured, sigma, SHAPE) is None


def test_columns_that_are_shifted_are_told() -> None:
    rng = np.random.default_rng(4)
    xy, sigma = places(100), np.full(100, 0.1)
    measured = xy + 0.1 * rng.normal(size=(100, 2)) + np.outer(xy[:, 1] > 300, [4.0, 0.0])
    tear = find_line_loss(xy, measured, sigma, SHAPE)
    assert tear is not None
    row, off_px = tear
    assert abs(row - 300) < 12  # the next of the rows that are tried
    np.testing.assert_allclose(off_px, [4.0, 0.0], rtol=0, atol=0.2)
