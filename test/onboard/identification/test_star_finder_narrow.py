# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars of narrow fields, from 5 an image, with the uncertainty of the attitude that is stated."""

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
from sample_sky import exposure_of, started, true_px, with_pixels  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from bench.lost_in_space import find_sky
from bench.narrow import scenario_of
from starcal_ground.blind.bright_sources import bright_sources
from starcal_ground.blind.search import SkyMatch
from starcal_ground.simulation.scenario import Scenario, scenario, Scene
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import (
    Exposure,
    IdentificationOptions,
    observe_stars,
    StarSearch,
)
from starcal_ros.identification.tracking import track_stars
from starcal_ros.records import CameraGeometry, StarObservations
from starcal_ros.sky.astrometry import air_above, SiteOptions
from starcal_ros.sky.catalog import load_catalog, StarCatalog


@functools.cache
def given(field_deg: float) -> Scenario:
    return scenario_of(field_deg, 3)


@functools.cache
def shown(field_deg: float, index: int, stars: int | None = None) -> tuple[Scene, Exposure]:
    """An image of a narrow camera, of its brightest stars."""
    few = dataclasses.replace(given(field_deg), stars_per_image=stars)
    return exposure_of(few, index)  # type: ignore[no-any-return]


def sky_of(field_deg: float) -> StarCatalog:
    sky = given(field_deg).sky
    return load_catalog() if sky is None else sky


def observed(
    field_deg: float, exposure: Exposure, off_deg: float, sigma_deg: float
) -> StarObservations:
    """Observations with a mounting off by an angle and stated with a sigma."""
    turn = Rotation.from_rotvec(math.radians(off_deg) * np.array([0.6, -0.8, 0.5]))
    truth, prior = given(field_deg).truth, given(field_deg).prior
    mounting = (truth.star_tracker_from_camera * turn).as_quat()
    options = IdentificationOptions(
        magnitude_limit=given(field_deg).magnitude_limit, prior_alignment_sigma_deg=sigma_deg
    )
    search = StarSearch(
        sky_of(field_deg), identification=options, tracker_sigma_rad=20.0 * ARCSECOND_RAD
    )
    return observe_stars(exposure, CameraGeometry(prior.camera, mounting), search)[0]


def wrong(found: StarObservations, one: Scene) -> int:
    """Number of stars that are not at the pixel of their catalog number."""
    off_px = np.hypot(*(found.measured_px - true_px(one, found.catalog_id)).T)
    return int((~(off_px < 1.0)).sum())


@pytest.mark.parametrize(
    ('field_deg', 'off_deg', 'sigma_deg'),
    [
        (0.3, 5 / 3600, 5 / 3600),
        (0.3, 0.3, 0.3),
        (1.0, 120 / 3600, 0.5),
        (2.5, 1.0, 0.5),
    ],
)
def test_the_window_follows_the_stated_sigma(field_deg, off_deg, sigma_deg) -> None:
    for index in (1, 4):
        one, exposure = shown(field_deg, index)
        found = observed(field_deg, exposure, off_deg, sigma_deg)
        assert found.refusal == '' and len(found) >= 8
        assert wrong(found, one) == 0


def test_a_stated_sigma_that_is_too_small_gives_no_match() -> None:
    with pytest.raises(ImageRefused, match='no_match'):
        observed(0.3, shown(0.3, 1)[1], 0.3, 0.005)


@pytest.mark.parametrize(('stars', 'least'), [(5, 2), (7, 4), (15, 4)])
def test_five_stars_are_enough(stars: int, least: int) -> None:
    right = 0
    for index in range(4):
        one, exposure = shown(0.3, index, stars)
        found = observed(0.3, exposure, 0.01, 0.01)
        if found.refusal == '':
            right += 1
            assert wrong(found, one) == 0
    assert right >= least  # of five, each has to be measured well
    with pytest.raises(ImageRefused, match='no_stars: [34] star-like sources, 5 needed'):
        observed(0.3, shown(0.3, 1, 3)[1], 0.01, 0.01)


@pytest.mark.parametrize(
    ('middle_px', 'radius_px'),
    [((400.0, 320.0), 60.0), ((650.0, 500.0), 150.0), ((0.0, 0.0), 300.0)],
    ids=['disc', 'large disc', 'limb'],
)
@pytest.mark.parametrize('off_deg', [0.002, 0.3], ids=['near', 'searched'])
def test_the_limb_of_a_body_is_no_streak(middle_px, radius_px, off_deg) -> None:
    one, exposure = shown(0.5, 4)
    v, u = np.indices(exposure.image.pixels.shape)
    lit = np.hypot(u - middle_px[0], v - middle_px[1]) < radius_px
    # Its light has the noise of photons, which makes sources all over it.
    noise = np.random.default_rng(1).normal(size=lit.shape)
    pixels = np.where(lit, 9000.0 + 95.0 * noise, exposure.image.pixels).astype(np.uint16)
    found = observed(0.5, with_pixels(exposure, pixels), off_deg, 0.2)
    assert not found.refusal, found.detail
    assert len(found.catalog_id) >= 8
    assert wrong(found, one) == 0


@pytest.mark.parametrize('rays', [0, 60])
def test_the_psf_is_that_of_stars_not_of_cosmic_rays(rays) -> None:
    one, exposure = shown(0.5, 4)
    pixels, rng = exposure.image.pixels.copy(), np.random.default_rng(2)
    v, u = rng.integers([5, 5], np.array(pixels.shape) - 5, (rays, 2)).T
    for part, (down, across) in ((1.0, (0, 0)), (0.6, (0, 1)), (0.3, (1, 0))):
        pixels[v + down, u + across] += np.uint16(part * 900)
    found = observed(0.5, with_pixels(exposure, pixels), 0.002, 0.02)
    assert found.psf_sigma_px == pytest.approx(given(0.5).detector.psf_sigma_px, rel=0.1)
    assert len(found) >= 14
    assert wrong(found, one) == 0


def faint(index: int, **detector: Any) -> tuple[Scene, Exposure]:
    """An image of a short exposure: fewer than five of its stars are over 15 sigma."""
    of_small = scenario('small', 1)
    changed = dataclasses.replace(of_small.detector, **detector)
    return exposure_of(dataclasses.replace(of_small, detector=changed), index)  # type: ignore[no-any-return]


def test_few_faint_stars_show_the_psf() -> None:
    truth, search = scenario('small', 1).truth, StarSearch(load_catalog())
    for index in (2, 5, 6):
        one, exposure = faint(index, psf_sigma_px=0.95, zero_point_electrons=1.5e4)
        found, _ = observe_stars(exposure, truth, search)
        assert found.refusal == '' and len(found) >= 8
        assert wrong(found, one) == 0
        # Eight stars of 10 sigma show it to 3 %.
        assert found.psf_sigma_px == pytest.approx(0.95, rel=0.1)


def test_the_noise_is_learned_from_stars_too_faint_for_the_psf() -> None:
    truth, search = scenario('small', 1).truth, StarSearch(load_catalog())
    first, second = (faint(k, psf_sigma_px=0.4, zero_point_electrons=1e4)[1] for k in (0, 2))
    _, before = started(first, truth, search)
    after = track_stars(second, before, search)[1].instrument
    assert (after.width_normal == before.instrument.width_normal).all()
    assert after.noise.normal[0, 0] > 1.5 * before.instrument.noise.normal[0, 0]


def test_a_catalog_of_another_region_is_said_to_be() -> None:
    _, exposure = shown(0.3, 1)
    options = IdentificationOptions(magnitude_limit=14.0, prior_alignment_sigma_deg=0.1)
    sky = r'needed: RA \d.*, Dec [+-]\d.*, radius 0\.\d+ deg'
    where = rf'not_in_catalog: 0\.\d catalog stars to V = 14 in a field; {sky}'
    search = StarSearch(load_catalog(), identification=options)
    with pytest.raises(ImageRefused, match=where):
        observe_stars(exposure, given(0.3).truth, search)


def test_a_site_that_has_an_image_below_its_horizon_is_named() -> None:
    one, exposure = shown(2.5, 1)
    attitude_xyzw = one.icrf_from_star_tracker_xyzw
    geometry, search = given(2.5).truth, StarSearch(sky_of(2.5))
    boresight = geometry.icrf_from_camera(attitude_xyzw).apply([0.0, 0.0, 1.0])
    sites = (SiteOptions('ground', 1.0, longitude) for longitude in range(0, 360, 30))
    cosine = [float(air_above(one.time_ns, site)[0] @ boresight) for site in sites]
    away = SiteOptions('ground', 1.0, 30.0 * int(np.argmin(cosine)))
    with pytest.raises(ImageRefused, match='no_match: its attitude is below 10 degrees of elev'):
        observe_stars(dataclasses.replace(exposure, site=away), geometry, search)


@pytest.mark.parametrize('field_deg', [0.3, 2.5])
def test_stars_are_found_without_attitude_in_the_region_of_the_catalog(field_deg: float) -> None:
    camera, catalog = given(field_deg).prior.camera, sky_of(field_deg)
    fx = 0.9 * float(camera.parameters[0])
    for index in (1, 2):
        one, exposure = shown(field_deg, index)
        sources = bright_sources(exposure.image.pixels)
        sky = find_sky(sources.xy_px, camera.replace(fx=fx, fy=fx), catalog, try_mirrored=True)
        assert isinstance(sky, SkyMatch) and not sky.mirrored
        off_px = sky.xy_px - true_px(one, catalog.id[sky.catalog_index])
        assert (np.hypot(*off_px.T) < 3.0).all()
