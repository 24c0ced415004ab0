# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars of a camera that turns during its exposures: measured, where they were at its middle."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from sample_sky import errors_sigma, exposure_of, started  # type: ignore[import-not-found]

from bench import narrow
from bench.frames import load_set_up, observed, render_frame
from starcal_ground.simulation.scenario import Detector, scenario, Scene
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import Exposure, observe_stars, StarSearch
from starcal_ros.identification.tracking import track_stars, TrackedCamera
from starcal_ros.records import StarObservations
from starcal_ros.sky.catalog import load_catalog

SCENARIO = scenario('tiny', seed=8)
FOCAL_PX = float(SCENARIO.truth.camera.parameters[0])
CORNER_PX = 410.0
SEARCH = StarSearch(load_catalog(None, 9.0))
Turn = tuple[float, float, float]  # rad, of an exposure
SHARP: Turn = (0.0, 0.0, 0.0)
LEAST = 0.45  # of the stars of a sharp image: streaks lie over each other and in their noise


def turned(u_px: float, v_px: float, roll_px: float) -> Turn:
    """Turn that moves stars by pixels in the middle and, by roll, in the corners."""
    return v_px / FOCAL_PX, u_px / FOCAL_PX, roll_px / CORNER_PX


@functools.cache
def exposed(
    turn_rad: Turn, index: int = 1, detector: Detector = SCENARIO.detector
) -> tuple[Scene, Exposure]:
    moving = dataclasses.replace(SCENARIO, turn_rad=turn_rad, detector=detector)
    shown, exposure = exposure_of(moving, index)
    return shown, exposure


@functools.cache
def sharp() -> tuple[StarObservations, TrackedCamera]:
    observations, track = started(exposed(SHARP)[1], SCENARIO.prior, SEARCH)
    return observations, track


@pytest.mark.parametrize(
    ('turn_rad', 'tracked'),
    [
        (turned(3.0, 0.0, 0.0), False),
        (turned(4.5, -4.5, 0.0), True),
        (turned(9.5, 0.0, 0.0), False),
        (turned(0.0, 0.0, 8.0), True),
        (turned(3.0, 3.0, 6.0), False),
        (turned(3.0, 3.0, 6.0), True),
    ],
    ids=['3 px', 'diagonal', '9.5 px', 'roll', 'turn and roll', 'turn and roll tracked'],
)
def test_streaks_are_measured_at_their_middle(turn_rad: Turn, tracked: bool) -> None:
    before, track = sharp()
    shown, image = exposed(turn_rad)
    if tracked:
        observations, after = track_stars(image, track, SEARCH)
        # The next image may be sharp again.
        assert after.instrument is track.instrument
    else:
        observations, _ = observe_stars(image, SCENARIO.prior, SEARCH)
    assert len(observations) > LEAST * len(before)
    error = errors_sigma(shown, observations)
    assert 0.85 < np.sqrt(np.mean(error**2)) < 1.15
    # A bent path is no bias: the mean of some 100 stars is good to 0.1 sigma per axis.
    assert np.abs(error.mean(axis=0)).max() < 0.35


def test_few_bright_stars_show_the_streaks_of_a_tracked_image() -> None:
    """Measured as sharp stars, most were refused as elongated."""
    given = narrow.scenario_of(5.0, 1, 6.0)
    set_up = load_set_up(given, prior_alignment_sigma_deg=0.01, magnitude_limit=9.0)
    frames = (render_frame(given, index) for index in range(2))
    image = observed(frames, set_up).images[1]
    # Four stars are brighter than 15 sigma, twelve than 8.  As sharp ones: 8 used, 11 elongated.
    assert len(image) > 20 and image.refused_stars.get('elongated', 0) < 3


def test_a_longer_streak_is_refused_with_its_length() -> None:
    _, image = exposed(turned(14.0, 0.0, 0.0))
    with pytest.raises(ImageRefused, match=r'streaks of \d+ px, up to 10') as refused:
        observe_stars(image, SCENARIO.prior, SEARCH)
    assert refused.value.reason == 'smeared'


@pytest.mark.parametrize('psf_sigma_px', [0.8, 1.0, 1.4])
def test_sharp_images_stay_tracked_whatever_their_focus(psf_sigma_px: float) -> None:
    _, track = sharp()
    detector = dataclasses.replace(SCENARIO.detector, psf_sigma_px=psf_sigma_px)
    for index in (2, 3, 4):
        _, track = track_stars(exposed(SHARP, index, detector)[1], track, SEARCH)


def test_streaks_of_which_too_few_are_alone_are_searched_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _, track = sharp()
    monkeypatch.setattr('starcal_ros.stars.image_model._ISOLATED_PX', 1000.0)
    with pytest.raises(ImageRefused, match='too few of them are alone') as refused:
        track_stars(exposed(turned(6.0, 0.0, 0.0))[1], track, SEARCH)
    assert refused.value.reason == 'no_match'
