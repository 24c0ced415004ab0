# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Pull of neighbours on centroids: against fits, and of stars below the magnitude limit."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from sample_sky import errors_sigma, image_model, tracked  # type: ignore[import-not-found]

from starcal_ground.simulation.rendering import star_electrons
from starcal_ground.simulation.scenario import scenario
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.identification.blending import (
    MAX_BLEND_SIGMA,
    neighbour_pulls,
    Pulls,
    unlisted_pull_px,
)
from starcal_ros.identification.star_finder import IdentificationOptions, StarSearch
from starcal_ros.sky.catalog import cone, DEEPER_MAG, load_catalog
from starcal_ros.stars.image_model import ImageModel
from starcal_ros.stars.pixel_noise import PixelNoise
from starcal_ros.stars.psf_fit import fit_psf, stamp_radius_px

SIGMA_PX = 0.95


def pull_of_a_neighbour(
    flux_dn: float, ratio: float, distance_px: float, noise_dn: float
) -> tuple[float, float, float]:
    """Error and 1-sigma (px), and flux (DN) of a fit to the mean image of two stars."""
    pair = np.array([[16.0, 16.0], [16.0 + distance_px, 16.0]])
    image = star_electrons(pair, flux_dn * np.array([1.0, ratio]), SIGMA_PX, (33, 33))
    r = stamp_radius_px(SIGMA_PX)
    stamp = image[None, 16 - r : 17 + r, 16 - r : 17 + r]
    fit = fit_psf(stamp, SIGMA_PX, np.array([noise_dn]), PixelNoise(4.0, 0.0))
    x_px, y_px, found_dn, _ = fit.parameters[0].tolist()
    return math.hypot(x_px, y_px), math.sqrt(fit.covariance[0, 0, 0]), found_dn


def pulls_on(
    xy_px: np.ndarray, magnitude: np.ndarray, flux_dn: np.ndarray, model: ImageModel
) -> Pulls:
    """Pulls on stars that are all measured, and none subtracted from another."""
    none = np.zeros(len(xy_px), bool)
    return neighbour_pulls(xy_px, magnitude, flux_dn, model, none, ~none, ~none)


def pulls(ratio: float, distance_px: float, flux_dn: list[float], noise_dn: float) -> Pulls:
    """Pulls on two stars whose fluxes are those that are measured."""
    pair = np.array([[16.0, 16.0], [16.0 + distance_px, 16.0]])
    magnitude = np.array([5.0, 5.0 - 2.5 * np.log10(ratio)])
    return pulls_on(pair, magnitude, np.array(flux_dn), image_model(noise_dn))


@pytest.mark.parametrize('flux_dn', [500.0, 20000.0])
@pytest.mark.parametrize('ratio', [0.01, 0.1, 0.45])
@pytest.mark.parametrize('distance_px', [0.5, 1.0, 2.0, 3.0, 4.0, 5.0])
def test_the_pull_of_a_neighbour_is_that_of_the_fit(flux_dn, ratio, distance_px) -> None:
    pull_px, sigma_px, measured_dn = pull_of_a_neighbour(flux_dn, ratio, distance_px, 2.1)
    found = pulls(ratio, distance_px, [measured_dn, ratio * measured_dn], 2.1).pull_px
    # How much of the neighbour is in the flux is told to a part of it; either fit ends within
    # three hundredths of its sigma.
    assert found[0, 0] == pytest.approx(pull_px, rel=0.12, abs=0.06 * sigma_px)
    assert abs(found[0, 1]) < 1e-9


def test_what_is_left_of_a_pull_that_is_let_pass_is_under_its_sigma() -> None:
    skies = ((200.0, 10.0), (500.0, 2.1), (2000.0, 10.0), (20000.0, 2.1))
    ratios, distances_px = (0.01, 0.1, 0.2, 0.3, 0.45), np.arange(1.0, 8.0, 0.5).tolist()
    for (flux_dn, noise_dn), ratio, px in itertools.product(skies, ratios, distances_px):
        pull_px, sigma_px, measured_dn = pull_of_a_neighbour(flux_dn, ratio, px, noise_dn)
        found = pulls(ratio, px, [measured_dn, ratio * measured_dn], noise_dn)
        uncertain_px = found.uncertain_px[0, 0]
        if not (found.swamped[0] or uncertain_px > MAX_BLEND_SIGMA * sigma_px):
            # The colour of the neighbour, which the uncertainty is for, is not in this.
            told_px = np.hypot(sigma_px, uncertain_px)
            assert abs(pull_px - found.pull_px[0, 0]) < 0.3 * told_px


@pytest.mark.parametrize('ratio', [0.02, 0.1, 0.3, 0.5])
def test_of_two_stars_that_look_like_one_the_centre_of_light_is_measured(ratio: float) -> None:
    distance_px = 0.1 * SIGMA_PX
    # What is measured is the flux of both.
    found = pulls(ratio, distance_px, [2000.0 * (1.0 + ratio)] * 2, 2.1).pull_px
    # To first order in the distance; the second is (distance / sigma)^2, 1 %.
    assert found[0, 0] == pytest.approx(ratio / (1.0 + ratio) * distance_px, rel=0.02)


def test_what_a_companion_that_the_catalog_has_not_may_pull() -> None:
    # A star of V = 5 in a catalog to V = 9: the companion has a fortieth of its light or less,
    # within 20 arcsec, here 2 px.
    px_per_rad = 2.0 / (20.0 * ARCSECOND_RAD)
    rng = np.random.default_rng(4)
    share = 10 ** (-0.4 * (4.0 + rng.uniform(0.0, 1.0, 100000)))
    away_px = 2.0 * rng.uniform(size=100000) * share
    drawn_px = np.sqrt(np.mean(away_px**2) / 2)
    found = unlisted_pull_px(np.array([5.0, 9.0, 9.5]), 9.0, px_per_rad)
    assert found[0] == pytest.approx(drawn_px, rel=0.05)  # 0.58 and 0.65 are rounded
    assert found[1] == found[2] == pytest.approx(10**1.6 * found[0])


def test_only_the_fainter_of_two_unlike_stars_is_swamped() -> None:
    pair = np.array([[100.0, 100.0], [104.0, 100.0], [300.0, 300.0]])
    flux = np.array([5000.0, 50.0, 800.0])
    found = pulls_on(pair, np.array([4.0, 9.0, 6.0]), flux, image_model(2.1))
    assert found.swamped.tolist() == found.outshone.tolist() == [False, True, False]
    assert 0 < found.pull_px[0, 0] < 0.05 and not found.pull_px[2].any()


def test_half_of_the_pull_is_taken_of_a_neighbour_that_the_border_may_cut_off() -> None:
    pair, flux = np.array([[100.0, 1.0], [100.0, -2.5]]), np.array([5000.0])
    model, magnitude, one = image_model(2.1), np.array([5.0, 6.0]), np.ones(1, bool)
    whole, cut = (
        neighbour_pulls(pair, magnitude, flux, model, ~one, one, np.array([True, inside]))
        for inside in (True, False)
    )
    assert 0 > cut.pull_px[0, 1] == pytest.approx(0.5 * whole.pull_px[0, 1])
    assert np.abs(cut.uncertain_px).tolist() == np.abs(cut.pull_px).tolist()


def test_no_neighbours_no_pulls() -> None:
    model = image_model(2.1)
    none = pulls_on(np.empty((0, 2)), np.empty(0), np.empty(0), model)
    assert none.pull_px.shape == (0, 2) and none.swamped.shape == (0,)
    alone = np.array([[5.0, 5.0]])
    assert not pulls_on(alone, np.array([3.0]), np.array([90.0]), model).pull_px.any()


def excess_sigma2(deeper: bool) -> float:
    """Mean square of the errors over their sigmas, of four images of which three are tracked."""
    # The sky of the bundled catalog to V = 7, in pixels of 1.7 arcmin.
    catalog = load_catalog(None, 7.0)
    if not deeper:
        catalog = dataclasses.replace(catalog, deeper=None)
    search = StarSearch(catalog, identification=IdentificationOptions(magnitude_limit=7.0))
    squares = []
    for shown, found, _ in tracked(scenario('tiny', seed=8), range(4), search):
        assert np.isin(found.refused_catalog_id, catalog.id).all()
        squares.append(errors_sigma(shown, found) ** 2)
    return float(np.mean(np.concatenate(squares)))


def test_the_pull_of_deeper_stars_is_taken_off() -> None:
    assert excess_sigma2(deeper=False) > 1.2
    assert excess_sigma2(deeper=True) < 1.1


@pytest.mark.parametrize('limit', [4.6, 5.0, 7.0, 9.0])
def test_deeper_stars_follow_the_limit(limit: float) -> None:
    catalog, deeper = load_catalog(None, limit), load_catalog(None, limit).deeper
    assert catalog.magnitude[-1] <= limit + 1e-9
    assert len(cone(catalog, np.array([1.0, 0.0, 0.0]), np.pi, limit)) == len(catalog)
    if limit == 9.0:
        assert deeper is None
        return
    assert deeper is not None
    assert limit < deeper.magnitude[0] and deeper.magnitude[-1] <= limit + DEEPER_MAG + 1e-9
    whole = load_catalog(None, limit + DEEPER_MAG)
    assert np.array_equal(np.concatenate([catalog.id, deeper.id]), whole.id)
