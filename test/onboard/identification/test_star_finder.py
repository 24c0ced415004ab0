# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Identification of simulated images: right stars or none, with wrong alignment or attitude."""

import dataclasses
import functools

from geometries import turned  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_sky import errors_sigma, exposure_of, true_px, with_pixels, with_planets  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import Detector, Scenario, scenario, Scene
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import (
    Exposure,
    IdentificationOptions,
    observe_stars,
    StarSearch,
)
from starcal_ros.records import CameraGeometry, STAR_REFUSALS, StarObservations
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.stars.image_model import CentroidOptions

SCENARIO = scenario('tiny', seed=6)
TRUTH, PRIOR = SCENARIO.truth, SCENARIO.prior
CATALOG = load_catalog(None, IdentificationOptions().magnitude_limit)
SEARCH = StarSearch(CATALOG)


@functools.cache
def shown(index: int) -> tuple[Scene, Exposure]:
    return exposure_of(SCENARIO, index)  # type: ignore[no-any-return]


def observed(
    exposure: Exposure, geometry: CameraGeometry = PRIOR, search: StarSearch = SEARCH
) -> StarObservations:
    return observe_stars(exposure, geometry, search)[0]


def drawn(one: Scene, index: int, scenario: Scenario = SCENARIO) -> Exposure:
    """The exposure of a campaign with another scene before the camera."""
    return dataclasses.replace(shown(index)[1], image=render(scenario, one, index))


def assert_right(found: StarObservations, one: Scene) -> None:
    """Assert that every star is at the pixel of its catalog number."""
    assert found.refusal == '' and len(found) >= 100
    in_sigma = np.abs(errors_sigma(one, found))
    assert np.isfinite(in_sigma).all()
    # Several hundred normal deviates, some of them pulled by a faint neighbour: a wrong star is
    # some hundred sigma off.
    assert in_sigma.max() < 6.0
    assert np.sqrt((in_sigma**2).mean()) < 1.2
    assert len(np.unique(found.catalog_id)) == len(found)


@pytest.mark.parametrize('index', [0, 3, 6, 9])
def test_every_star_is_the_right_one(index: int) -> None:
    one, exposure = shown(index)
    found = observed(exposure)
    assert_right(found, one)
    assert found.psf_sigma_px == pytest.approx(SCENARIO.detector.psf_sigma_px, rel=0.02)
    assert (found.catalog_digest, found.time_ns) == (CATALOG.digest, exposure.image.time_ns)
    magnitude = dict(zip(one.catalog_id.tolist(), one.magnitude, strict=True))
    expected = [magnitude[number] for number in found.catalog_id]
    np.testing.assert_allclose(found.magnitude, expected, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.direction_icrf, axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ('index', 'tilt_deg', 'roll_deg'),
    [(0, 0.1, -4.9), (4, 0.7, 0.0), (8, 1.45, 4.9), (4, 1.45, -4.9), (0, 1.45, 0.0)],
)
def test_an_alignment_that_launch_has_turned_is_acquired(index, tilt_deg, roll_deg) -> None:
    angle = np.random.default_rng(index).uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.radians(tilt_deg) * np.r_[np.cos(angle), np.sin(angle), 0.0])
    turn = tilt * Rotation.from_euler('z', roll_deg, degrees=True)
    one, exposure = shown(index)
    assert_right(observed(exposure, turned(PRIOR, turn)), one)


@pytest.mark.parametrize(('index', 'scale'), [(1, 0.98), (4, 1.02)])
def test_a_focal_length_two_percent_off_is_acquired(index: int, scale: float) -> None:
    fx, _, fy, _, _ = PRIOR.camera.intrinsics
    camera = PRIOR.camera.replace(fx=scale * fx, fy=scale * fy)
    one, exposure = shown(index)
    assert_right(observed(exposure, dataclasses.replace(PRIOR, camera=camera)), one)


def test_a_wrong_attitude_never_matches() -> None:
    # Anywhere in the sky: that one of 40 comes within 1.5 degrees is a chance of 0.01.
    for index in range(4):
        for seed in range(10):
            attitude = Rotation.random(random_state=100 * index + seed).as_quat()
            with pytest.raises(ImageRefused) as refusal:
                observed(Exposure(shown(index)[1].image, attitude, 0.5))
            assert refusal.value.reason == 'no_match'


def test_hot_pixels_and_missing_and_strange_stars() -> None:
    one, _ = shown(1)
    rng = np.random.default_rng(7)
    seen = rng.uniform(size=len(one.catalog_id)) < 0.6
    strange = rng.uniform([0, 0], [639, 511], (40, 2))
    other = dataclasses.replace(
        one,
        pixel_px=np.concatenate([one.pixel_px[seen], strange]),
        flux_electrons=np.concatenate([one.flux_electrons[seen], 10 ** rng.uniform(3, 4.5, 40)]),
    )
    detector = dataclasses.replace(SCENARIO.detector, hot_fraction=5e-3, cosmic_rays=20.0)
    found = observed(drawn(other, 1, dataclasses.replace(SCENARIO, detector=detector)))
    # Hardly any star that was not drawn is found: one of the strange ones stands in its place.
    missing = set(one.catalog_id[~seen].tolist())
    assert sum(number in missing for number in found.catalog_id.tolist()) <= 1
    off_px = np.linalg.norm(found.measured_px - true_px(one, found.catalog_id), axis=1)
    # A strange star beside a true one pulls it; the catalog knows nothing of it.
    assert len(found) > 80 and (off_px < 1.0).mean() > 0.98


@pytest.mark.parametrize(('index', 'turn_deg'), [(0, 0.0), (4, 0.0), (2, 1.0), (7, 1.0)])
def test_planets_are_no_stars(index: int, turn_deg: float) -> None:
    one, _ = shown(index)
    exposure = drawn(with_planets(SCENARIO, one, index), index)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array([0.6, -0.8, 2.0]))
    assert_right(observed(exposure, turned(PRIOR, turn)), one)


def reasons(found: StarObservations) -> dict[int, str]:
    """Refusal reasons by catalog number."""
    names = list(found.refused_stars)
    pairs = zip(found.refused_catalog_id.tolist(), found.refused_reason.tolist(), strict=True)
    return {number: names[code] for number, code in pairs}


def moved_right(pixels: np.ndarray, u: int, v: int, shift: int) -> None:
    window = slice(v - 7, v + 8), slice(u - 7, u + 8)
    pixels[window] = np.roll(pixels[window], shift, axis=1)


def sharpened(pixels: np.ndarray, u: int, v: int) -> None:
    """Keep only the three brightest pixels around a pixel."""
    window = pixels[v - 4 : v + 5, u - 4 : u + 5]
    window[window < np.sort(window.ravel())[-3]] = np.median(pixels)


@pytest.mark.parametrize(
    ('reason', 'centroid', 'spoil'),
    [
        # Another source stands where the star should, and too near to be told from it.
        ('ambiguous', 'psf', functools.partial(moved_right, shift=1)),
        ('ambiguous', 'moment', functools.partial(moved_right, shift=2)),
        # The pixel next to the prediction is lit by something that stands elsewhere.
        ('not_detected', 'psf', functools.partial(moved_right, shift=3)),
        ('too_few_pixels', 'moment', sharpened),
    ],
)
def test_one_spoilt_star_is_left_out_by_its_reason(reason, centroid, spoil) -> None:
    one, exposure = shown(0)
    search = StarSearch(CATALOG, CentroidOptions(centroid=centroid))
    before = observed(exposure, PRIOR, search)
    apart = np.linalg.norm(one.pixel_px[:, None] - one.pixel_px[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    alone = set(one.catalog_id[apart.min(axis=1) > 15.0].tolist())
    brightest = next(k for k in np.argsort(-before.flux_dn) if before.catalog_id[k] in alone)
    star = int(before.catalog_id[brightest])
    pixels = exposure.image.pixels.copy()
    spoil(pixels, *np.rint(before.measured_px[brightest]).astype(int).tolist())
    after = observed(with_pixels(exposure, pixels), PRIOR, search)
    # Those at a limit may change from one refusal to another, as the noise is found anew.
    fell_out = {
        number: why for number, why in reasons(after).items() if number not in reasons(before)
    }
    assert fell_out == {star: reason}
    assert reason in STAR_REFUSALS


def noise(sky: np.ndarray, seed: int) -> np.ndarray:
    return np.asarray(np.random.default_rng([8, seed]).normal(100, 5, sky.shape), sky.dtype)


@pytest.mark.parametrize(
    ('made_of', 'refusals'),
    [
        (lambda sky: np.zeros_like(sky), ['no_stars']),
        (lambda sky: np.full_like(sky, 4095), ['no_stars']),
        *((functools.partial(noise, seed=k), ['no_stars', 'no_match']) for k in range(2)),
        (lambda sky: sky[:, ::-1].copy(), ['no_match']),
    ],
    ids=['dark', 'bright', *map('noise {}'.format, range(2)), 'mirrored'],
)
def test_an_image_without_the_stars_matches_nothing(made_of, refusals) -> None:
    _, exposure = shown(1)
    with pytest.raises(ImageRefused) as refusal:
        observed(with_pixels(exposure, made_of(exposure.image.pixels)))
    assert refusal.value.reason in refusals


def test_refused_stars_are_told_with_their_places() -> None:
    one, exposure = shown(0)
    search = StarSearch(CATALOG, CentroidOptions(min_snr=400.0))
    refused = observed(exposure, PRIOR, search)
    assert (refused.refusal, len(refused)) == ('too_few_stars', 0)
    assert ' stars measured, ' in refused.detail
    # What became of the others is told all the same.
    assert refused.refused_stars['faint'] > 100 and len(refused.refused_px) > 100
    found = observed(exposure)
    assert not set(found.refused_catalog_id) & set(found.catalog_id)
    counted = {reason: len(places) for reason, places in found.refused_places().items()}
    assert counted == found.refused_stars and {'blend', 'faint'} <= set(counted)
    # The match refines the predictions to a fraction of the pixel in which a star is looked for.
    assert np.abs(found.refused_px - true_px(one, found.refused_catalog_id)).max() < 0.5


def test_a_companion_that_the_catalog_has_not_makes_a_star_less_sure(monkeypatch) -> None:
    _, exposure = shown(2)
    marked = StarSearch(dataclasses.replace(CATALOG, close_pair=np.ones(len(CATALOG), bool)))
    before, after = observed(exposure), observed(exposure, PRIOR, marked)
    monkeypatch.setattr('starcal_ros.identification.blending.MAX_BLEND_SIGMA', 0.1)
    fewer = observed(exposure, PRIOR, marked)
    assert fewer.refused_stars['blend'] > after.refused_stars['blend']
    both, i, j = np.intersect1d(before.catalog_id, after.catalog_id, return_indices=True)
    more_px2 = after.covariance_px2[j] - before.covariance_px2[i]
    assert len(both) > 50 and (more_px2[:, [0, 2]] >= 0).all() and more_px2[:, 0].max() > 1e-6
    # Stars whose companion is in the catalog have it taken off, mark or no mark.
    np.testing.assert_array_equal(after.measured_px[j], before.measured_px[i])


def test_a_star_beyond_the_border_spoils_the_one_beside_it() -> None:
    one, exposure = shown(0)
    found = observed(exposure)
    star = found.catalog_id[(found.measured_px[:, 0] > 400) & (found.snr > 30)][0]
    (u, _), (row,) = true_px(one, np.array([star]))[0], CATALOG.rows_of(np.array([star]))[0]
    width = int(u) + 3
    camera = dataclasses.replace(PRIOR.camera, width=width)
    cut = with_pixels(exposure, np.ascontiguousarray(exposure.image.pixels[:, :width]))
    # The same star again, 4 px farther to the right.
    twice = CATALOG.select(np.insert(np.arange(len(CATALOG)), row, row))
    x, y, z = twice.direction_icrs[row] + 4.0 / camera.parameters[0] * one.camera_from_icrf[0]
    ra_rad, dec_rad, number = twice.ra_rad.copy(), twice.dec_rad.copy(), twice.id.copy()
    ra_rad[row], dec_rad[row] = np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))
    number[row] = number.max() + 1
    twice = dataclasses.replace(twice, ra_rad=ra_rad, dec_rad=dec_rad, id=number)
    geometry = dataclasses.replace(PRIOR, camera=camera)
    alone, beside = (observed(cut, geometry, StarSearch(sky)) for sky in (CATALOG, twice))
    assert star in alone.catalog_id and star not in beside.catalog_id
    assert len(beside) == len(alone) - 1


def test_an_unknown_proper_motion_is_in_the_covariance() -> None:
    """Ten years of the usual motion in a camera of 100 arcsec a pixel, and nothing else."""
    _, exposure = shown(0)
    unmoved = dataclasses.replace(CATALOG, motion_source=np.zeros_like(CATALOG.motion_source))
    moved, still = observed(exposure), observed(exposure, PRIOR, StarSearch(unmoved))
    row = {number: k for k, number in enumerate(CATALOG.id.tolist())}
    sigma_rad = unmoved.place_sigma_rad(np.array([row[n] for n in still.catalog_id]), 2026.4)
    more_px2 = np.outer((sigma_rad * PRIOR.camera.parameters[0]) ** 2, [1.0, 0.0, 1.0])
    assert still.measured_px.tolist() == moved.measured_px.tolist()
    # Moved stars have that of a motion by difference.
    assert still.covariance_px2 - moved.covariance_px2 == pytest.approx(more_px2, rel=0.05)


def test_stars_with_an_unknown_companion_are_told_by_their_shape() -> None:
    # Each brighter star has a companion of half its light, 3 px away, that the catalog has not.
    one, _ = shown(4)
    bright = one.flux_electrons > 3000
    companion = one.pixel_px[bright] + np.array([2.4, 1.8])
    other = dataclasses.replace(
        one,
        pixel_px=np.concatenate([one.pixel_px, companion]),
        flux_electrons=np.concatenate([one.flux_electrons, 0.5 * one.flux_electrons[bright]]),
    )
    quiet = Detector(cosmic_rays=0.0, hot_fraction=0.0, electrons_per_dn=8.0, offset_dn=32.0)
    found = observed(drawn(other, 4, dataclasses.replace(SCENARIO, detector=quiet)))
    doubled = set(one.catalog_id[bright].tolist())
    kept = [number in doubled for number in found.catalog_id.tolist()]
    assert len(doubled) > 10 and np.count_nonzero(kept) <= 2
