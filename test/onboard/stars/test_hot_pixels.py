# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Hot pixels are learnt from the images, known from a dark frame, and never measured as stars."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.simulation import rendering, scenario
from starcal_ros.arrays import Pixels
from starcal_ros.camera import CameraModel
from starcal_ros.records import StarRefusal
from starcal_ros.stars.hot_pixels import (
    hot_in_dark,
    HotPixels,
    learn_hot_pixels,
    refuse_on_hot_pixels,
)

UNKNOWN = HotPixels(np.empty(0, np.int64))
SCENARIO = scenario.scenario('tiny', seed=3)
DETECTOR = SCENARIO.detector
CAMERA = SCENARIO.truth.camera
WIDTH = CAMERA.width
BACKGROUND_DN = DETECTOR.offset_dn + DETECTOR.background_electrons / DETECTOR.electrons_per_dn
NOISE_DN = DETECTOR.noise_electrons / DETECTOR.electrons_per_dn


@functools.cache
def images(count: int, looking: int | None = None) -> tuple[tuple[Pixels, Rotation], ...]:
    """Frames and where the camera looked: at one field after the other, or at one all the time."""
    pattern, made = rendering.fixed_pattern(SCENARIO), []
    for k in range(count):
        one = scenario.scene(SCENARIO, k if looking is None else looking)
        pixels = rendering.render(SCENARIO, one, k, pattern).pixels
        made.append((pixels, Rotation.from_matrix(one.camera_from_icrf).inv()))
    return tuple(made)


def learnt(seen: tuple[tuple[Pixels, Rotation], ...], known: HotPixels = UNKNOWN) -> HotPixels:
    for pixels, looking in seen:
        known = learn_hot_pixels(known, pixels, BACKGROUND_DN, NOISE_DN, looking, CAMERA)
    return known


def hot_in_truth(sigmas: float) -> set[int]:
    """Hot pixels of the simulated detector so far above its noise, not on its border."""
    excess = rendering.fixed_pattern(SCENARIO) - DETECTOR.background_electrons
    inner = np.pad(excess[1:-1, 1:-1], 1)
    return set(np.flatnonzero(inner > sigmas * DETECTOR.noise_electrons).tolist())


def test_hot_pixels_are_learnt_from_two_fields() -> None:
    found = set(learnt(images(2)).index.tolist())
    # The faint are lit in one image and not in the other; those next to another are not single.
    assert len(hot_in_truth(15.0) - found) <= 0.05 * len(hot_in_truth(15.0))
    assert len(hot_in_truth(15.0)) > 25
    assert found <= hot_in_truth(5.0)


def test_stars_that_stand_still_are_not_hot() -> None:
    """The same field for long: nothing tells a star from a hot pixel, and nothing is learnt."""
    assert len(learnt(images(4, looking=0)).index) == 0


def test_cosmic_rays_are_not_hot() -> None:
    rng = np.random.default_rng(1)
    known = UNKNOWN
    for turn_deg in range(6):
        pixels = rng.normal(BACKGROUND_DN, NOISE_DN, (512, 640))
        v, u = rng.integers(1, 500, (2, 50))
        pixels[v, u] += 40 * NOISE_DN
        looking = Rotation.from_euler('x', turn_deg, degrees=True)
        known = learnt(((np.rint(pixels).astype(np.uint16), looking),), known)
    assert len(known.index) == 0


def test_a_roll_moves_no_star_at_its_axis() -> None:
    """Lit all the time: a pixel near the axis, which may be a star, and one 270 px from it."""
    pixels = np.full((CAMERA.height, WIDTH), round(BACKGROUND_DN), np.uint16)
    u, v = np.rint(CAMERA.parameters[3:5]).astype(int)
    pixels[v, [u - 20, u + 270]] += round(40 * NOISE_DN)
    rolled = [Rotation.from_rotvec([0.0, 0.0, 0.005 * k]) for k in range(9)]
    known, found = UNKNOWN, []
    for looking in (*rolled, Rotation.from_euler('x', 1, degrees=True)):
        known = learnt(((pixels, looking),), known)
        found.append(len(known.index))
    assert found == [0, 0, 0, 0, 1, 1, 1, 1, 1, 2]


def test_large_detectors_are_scanned_in_turns() -> None:
    """Eleven strips: each is seen a second time by the twenty-second image."""
    hot = np.array([[3, 100], [1000, 1300], [2000, 2500]])
    noise = np.random.default_rng(2).normal(100.0, 2.0, (2048, 2592))
    pixels = np.rint(noise).astype(np.uint16)
    pixels[hot[:, 0], hot[:, 1]] = 300
    camera = CameraModel(2592, 2048, np.array([7e3, 0, 7e3, 1295.5, 1023.5, 0, 0, 0, 0, 0]))
    known, found = UNKNOWN, []
    for looking in Rotation.from_euler('x', np.arange(22)[:, None], degrees=True):
        known = learn_hot_pixels(known, pixels, 100.0, 2.0, looking, camera)
        found.append(len(known.index))
    assert found == [0] * 11 + [1] * 5 + [2] * 5 + [3]
    np.testing.assert_array_equal(known.index, hot @ [2592, 1])


def test_hot_pixels_of_a_dark_frame() -> None:
    dark = np.random.default_rng(3).normal(64.0, 2.0, (200, 300)).round().astype(np.uint16)
    dark[10, 20], dark[150, 299] = 90, 4095
    np.testing.assert_array_equal(hot_in_dark(dark).index, [10 * 300 + 20, 150 * 300 + 299])
    assert len(hot_in_dark(None).index) == 0


@pytest.mark.parametrize(
    ('offset', 'psf_px', 'before', 'after'),
    [
        ((0.0, 0.0), 1.0, StarRefusal.NONE, StarRefusal.HOT_PIXEL),  # in the core
        ((1.0, -1.0), 1.0, StarRefusal.NONE, StarRefusal.HOT_PIXEL),
        # Beside it: the fit does without the pixel.
        ((2.0, 0.0), 1.0, StarRefusal.NONE, StarRefusal.NONE),
        # In the window, and the cause.
        ((3.0, 3.0), 1.0, StarRefusal.ELONGATED, StarRefusal.HOT_PIXEL),
        ((6.0, 0.0), 1.0, StarRefusal.ELONGATED, StarRefusal.ELONGATED),  # elsewhere
        ((0.0, 0.0), 1.0, StarRefusal.FAINT, StarRefusal.FAINT),  # it would be left out anyway
        # No pixel of a PSF of two pixels holds a twentieth of its light.
        ((0.0, 0.0), 2.0, StarRefusal.NONE, StarRefusal.NONE),
        ((0.0, 0.0), 2.0, StarRefusal.ELONGATED, StarRefusal.HOT_PIXEL),
    ],
)
def test_stars_on_hot_pixels(offset, psf_px, before, after) -> None:
    """Fitted in a window of four pixels about a star of one pixel, seven about one of two."""
    hot, star = np.array([50 * WIDTH + 70]), np.array([[70.0, 50.0]]) + offset
    refusal, radius_px = np.array([before], np.uint8), round(1.0 + 3.0 * psf_px)
    found = refuse_on_hot_pixels(star, refusal, hot, WIDTH, radius_px, psf_px)
    assert found.tolist() == [after]
