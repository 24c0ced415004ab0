# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images of a simulated campaign, where their stars are, planets; a detector without defects."""

from collections.abc import Iterable, Iterator
import dataclasses
import functools

import numpy as np

from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import Detector, Scenario, Scene, scene
from starcal_ros.identification.star_finder import Exposure, observe_stars, StarSearch
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.stars.centroiding import Centroids, measure_stars
from starcal_ros.stars.detection import Background, detect, measure_background
from starcal_ros.stars.image_model import CentroidOptions, ImageModel, model_image, uniform_width
from starcal_ros.stars.pixel_noise import PixelNoise

CENTROIDS = CentroidOptions()
QUIET = Detector(cosmic_rays=0.0, hot_fraction=0.0)
# Venus, Jupiter, Mars, Saturn, Mercury, and Uranus, which resembles a star.
PLANET_MAGNITUDES = np.array([-4.2, -2.3, -1.0, 0.4, 1.5, 5.8])


def star_grid(seed: int, spacing: int = 24, shape: tuple[int, int] = (512, 640)) -> np.ndarray:
    """Places (n, 2) a spacing apart, each anywhere in its pixel."""
    v, u = np.mgrid[spacing : shape[0] - spacing : spacing, spacing : shape[1] - spacing : spacing]
    phase = np.random.default_rng([seed, 0]).uniform(-0.5, 0.5, (u.size, 2))
    return np.asarray(np.stack([u.ravel(), v.ravel()], axis=-1) + phase)


@functools.cache
def corona() -> np.ndarray:
    """A sky that falls off from one side, as beside the Sun."""
    v, u = np.mgrid[:1024, :960]
    light = 60000.0 / (1.0 + np.hypot(u + 100.0, v - 512.0) / 150.0) ** 2
    electrons = np.random.default_rng(6).poisson(20.0 * (light + 500.0))
    return np.asarray(np.rint(electrons / 20.0), np.uint16)


def modelled(pixels: np.ndarray, options: CentroidOptions = CENTROIDS) -> ImageModel:
    """Model of an image by the stars that it shows."""
    background = measure_background(pixels)
    return model_image(pixels, background, detect(pixels, background), options)


def measured(
    pixels: np.ndarray, xy: np.ndarray, options: CentroidOptions = CENTROIDS
) -> Centroids:
    """Centroids of the stars of an image that are at or near these pixels (n, 2)."""
    return measure_stars(pixels, xy, modelled(pixels, options), options)


def image_model(noise_dn: float, shape: tuple[int, int] = (33, 33)) -> ImageModel:
    """Model of an image with stars of 0.95 px on a sky of this noise."""
    mesh = np.zeros((1, 1), np.float32)
    background = Background(mesh, mesh + np.float32(noise_dn), 0.0, noise_dn, shape)
    psf = uniform_width(0.95, shape[1], shape[0])
    return ImageModel(background, psf, PixelNoise(4.0, 0.0), 4095.0, np.zeros(3), np.zeros(3))


def with_planets(scenario: Scenario, shown: Scene, seed: int) -> Scene:
    """Scene with six planets: four at 3 to 25 px from a bright star, two at random pixels."""
    rng = np.random.default_rng(seed)
    camera = scenario.truth.camera
    size = np.array([camera.width, camera.height])
    rim_px = 30.0
    inside = ((shown.pixel_px > rim_px) & (shown.pixel_px < size - rim_px)).all(axis=1)
    bright = np.flatnonzero(inside)[np.argsort(shown.magnitude[inside])[:40]]
    angle = rng.uniform(0, 2 * np.pi, 4)
    away_px = np.array([25.0, 12.0, 6.0, 3.0])[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )
    beside = shown.pixel_px[rng.choice(bright, 4, replace=False)] + away_px
    anywhere = rng.uniform(rim_px, size - rim_px, (2, 2))
    light = scenario.detector.zero_point_electrons * 10 ** (-0.4 * PLANET_MAGNITUDES)
    return dataclasses.replace(
        shown,
        pixel_px=np.concatenate([shown.pixel_px, beside, anywhere]),
        flux_electrons=np.concatenate([shown.flux_electrons, light]),
    )


def exposure_of(scenario: Scenario, index: int) -> tuple[Scene, Exposure]:
    """Scene and image of a campaign, with the attitude of its star tracker."""
    shown = scene(scenario, index)
    image = render(scenario, shown, index)
    return shown, Exposure(image, shown.icrf_from_star_tracker_xyzw, 0.5)


def with_pixels(exposure: Exposure, pixels: np.ndarray) -> Exposure:
    return dataclasses.replace(exposure, image=Image(exposure.image.time_ns, pixels))


def true_px(shown: Scene, catalog_id: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of stars of a scene by catalog number; NaN for those that it does not show."""
    place = dict(zip(shown.catalog_id.tolist(), shown.pixel_px, strict=True))
    pixels = [place.get(number, np.full(2, np.nan)) for number in catalog_id.tolist()]
    return np.array(pixels).reshape(-1, 2)


def errors_sigma(shown: Scene, found: StarObservations) -> np.ndarray:
    """Errors (n, 2) of the centroids over their sigmas; NaN for a star that is not shown."""
    sigma_px = np.sqrt(found.covariance_px2[:, [0, 2]])
    return np.asarray((found.measured_px - true_px(shown, found.catalog_id)) / sigma_px)


def started(
    exposure: Exposure, geometry: CameraGeometry, search: StarSearch
) -> tuple[StarObservations, TrackedCamera]:
    """Observations of a searched image, and the track that it starts."""
    found, instrument = observe_stars(exposure, geometry, search)
    track = start_tracking(geometry, found, instrument)
    assert track is not None
    return found, track


def tracked(
    scenario: Scenario, indices: Iterable[int], search: StarSearch
) -> Iterator[tuple[Scene, StarObservations, TrackedCamera]]:
    """Images of a campaign: the first is searched from the prior, the others are tracked."""
    track: TrackedCamera | None = None
    for index in indices:
        shown, exposure = exposure_of(scenario, index)
        if track is None:
            found, track = started(exposure, scenario.prior, search)
        else:
            found, track = track_stars(exposure, track, search)
        yield shown, found, track
