# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated images of a star field.

Modelled: pixel-integrated Gaussian stars with a PSF that may widen towards the corners; a turn of
the camera during the exposure; photon, dark and read noise; hot pixels; cosmic rays; saturation;
quantisation.  Not modelled: flat-field errors.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import erf

from starcal_ground.simulation import scenario as synthetic
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import project
from starcal_ros.records import Image

_TOGETHER = 4000  # stars whose pixels are summed at once: 5 MB, which a cache holds


def pixel_stamps(
    centers_px: Floats,
    psf_sigma_px: float | Floats,
    off_px: float | Floats = 0.0,
    reach_px: int = 0,
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """
    Pixel indices around centers (n,) on one axis, with the share of light and its derivative.

    The light is ``off_px`` (n,), at most ``reach_px``, from the center.

    Returns
    -------
    pixels : (n, m)
    share : (n, m)
        Integral of the Gaussian over each pixel.
    slope : (n, m)
        Derivative of the share by the center, 1/px.
    """
    sigma_px = np.broadcast_to(np.asarray(psf_sigma_px, np.float64), centers_px.shape)
    half = synthetic.stamp_half_px(float(sigma_px.max(initial=0.1))) + reach_px
    edges = np.arange(-half, half + 2) - 0.5
    nearest = np.rint(centers_px).astype(np.int64)
    width = math.sqrt(2) * sigma_px[:, None]
    z = (nearest[:, None] + edges - (centers_px + off_px)[:, None]) / width
    density = np.exp(-z * z) / (math.sqrt(math.pi) * width)
    pixels = nearest[:, None] + np.arange(-half, half + 1)
    return pixels, np.diff(erf(z), axis=1) / 2, -np.diff(density, axis=1)


def star_electrons(
    pixels_px: Floats, flux_electrons: Floats, psf_sigma_px: float | Floats, shape: tuple[int, int]
) -> Floats:
    """Mean signal (height, width) of stars (n, 2), (n,): Gaussians integrated over each pixel."""
    height, width = shape
    u, share_u, _ = pixel_stamps(pixels_px[:, 0], psf_sigma_px)
    v, share_v, _ = pixel_stamps(pixels_px[:, 1], psf_sigma_px)
    light_u = share_u * ((u >= 0) & (u < width))
    light_v = flux_electrons[:, None] * share_v * ((v >= 0) & (v < height))
    light = light_v[:, :, None] * light_u[:, None, :]
    # Pixels beyond an edge have no light, so that they may be counted at the edge.
    cells = (v.clip(0, height - 1) * width)[:, :, None] + u.clip(0, width - 1)[:, None, :]
    electrons = np.bincount(cells.ravel(), light.ravel(), height * width).reshape(height, width)
    return np.asarray(electrons, np.float64)


def fixed_pattern(scenario: synthetic.Scenario) -> Floats:
    """Mean dark and sky signal (height, width), electrons; equal for all images."""
    detector, camera = scenario.detector, scenario.truth.camera
    rng = synthetic.random_stream(scenario.seed, synthetic.PATTERN_STREAM)
    pattern = np.full(camera.height * camera.width, detector.background_electrons)
    hot = rng.choice(pattern.size, round(detector.hot_fraction * pattern.size), replace=False)
    pattern[hot] += rng.exponential(detector.hot_electrons, hot.size)
    return pattern.reshape(camera.height, camera.width)


def cosmic_ray_electrons(
    detector: synthetic.Detector, shape: tuple[int, int], rng: np.random.Generator
) -> Floats:
    """Signal (height, width) of cosmic rays: tracks of random position, length and charge."""
    height, width = shape
    count = rng.poisson(detector.cosmic_rays)
    start = rng.uniform(0, [width, height], (count, 2))
    length_px = rng.exponential(4.0, count)
    angle = rng.uniform(0, 2 * np.pi, count)
    charge = rng.lognormal(math.log(3000.0), 0.7, count)  # electrons in the whole track
    along = np.linspace(0.0, 1.0, 64)
    u = start[:, :1] + (length_px * np.cos(angle))[:, None] * along
    v = start[:, 1:] + (length_px * np.sin(angle))[:, None] * along
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    cells = v[inside].astype(np.int64) * width + u[inside].astype(np.int64)
    share = np.broadcast_to(charge[:, None] / along.size, u.shape)[inside]
    electrons = np.bincount(cells, share, height * width).reshape(height, width)
    return np.asarray(electrons, np.float64)


def expose(
    mean_electrons: Floats, detector: synthetic.Detector, rng: np.random.Generator
) -> Pixels:
    """One exposure of a mean signal with photon noise, read noise and quantisation."""
    electrons = rng.poisson(mean_electrons) + rng.normal(
        0.0, detector.read_noise_electrons, mean_electrons.shape
    )
    counts = np.rint(electrons / detector.electrons_per_dn + detector.offset_dn)
    counts = np.clip(counts, 0, detector.full_dn)
    return counts.astype(np.uint8) if detector.bits <= 8 else counts.astype(np.uint16)


def render(
    scenario: synthetic.Scenario, shown: synthetic.Scene, index: int, pattern: Floats | None = None
) -> Image:
    """Image of a scene; pass the `fixed_pattern` to render many images faster."""
    detector, camera = scenario.detector, scenario.truth.camera
    shape = (camera.height, camera.width)
    rng = synthetic.random_stream(scenario.seed, synthetic.PIXEL_STREAM, index)
    mean = fixed_pattern(scenario) if pattern is None else pattern
    places_px = _places_px(scenario, shown)
    flux_electrons = shown.flux_electrons / len(places_px)
    for some_px in np.array_split(places_px, math.ceil(places_px[..., 0].size / _TOGETHER) or 1):
        flat_px = some_px.reshape(-1, 2)
        sigma_px = detector.psf_sigma_at(flat_px, shape)
        flux = np.tile(flux_electrons, len(some_px))
        mean = mean + star_electrons(flat_px, flux, sigma_px, shape)
    mean += cosmic_ray_electrons(detector, shape, rng)
    return Image(shown.time_ns, expose(mean, detector, rng))


def _places_px(scenario: synthetic.Scenario, shown: synthetic.Scene) -> Floats:
    """Places (parts, n, 2) of stars in equal parts of the exposure, a quarter of a pixel apart."""
    camera, turn_rad = scenario.truth.camera, np.array(scenario.turn_rad)
    if not turn_rad.any():
        return shown.pixel_px[None]
    at_corner = np.array([1.0, 1.0, 0.5 * math.hypot(camera.width, camera.height)])
    at_corner[:2] = camera.parameters[0]
    count = math.ceil(4.0 * float(np.abs(turn_rad) @ at_corner))
    in_camera = shown.direction_icrf @ shown.camera_from_icrf.T
    parts = (np.arange(count) + 0.5) / count - 0.5
    turns = Rotation.from_rotvec(-parts[:, None] * turn_rad)
    return np.stack([project(camera, turn.apply(in_camera)) for turn in turns])


def images(scenario: synthetic.Scenario) -> Iterator[Image]:
    """All images of a scenario, rendered on demand."""
    pattern = fixed_pattern(scenario)
    for index in range(scenario.image_count):
        yield render(scenario, synthetic.scene(scenario, index), index, pattern)
