# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Outliers: bad observations, stars and images are left out, sound ones are not."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.stats import chi2

from starcal_ros.arrays import Floats, Mask
from starcal_ros.estimation.limits import FALSE_ALARM_RATE, FEWEST
from starcal_ros.estimation.outliers import dropped_stars, fitting_stars, misfit_images
from starcal_ros.estimation.shared_errors import Groups, pairs_of
from starcal_ros.estimation.star_equations import StarTable

IMAGES, STARS = 12, 30
SIGMA_PX = 0.2


def table_of(image: NDArray[np.integer], star: NDArray[np.integer]) -> StarTable:
    n = len(image)
    return StarTable(
        image=np.asarray(image, np.int64),
        catalog_id=np.asarray(star, np.int64) * 10 + 5,
        star=np.asarray(star, np.int64),
        direction_icrf=np.tile([0.0, 0.0, 1.0], (n, 1)),
        magnitude=np.full(n, 5.0, np.float32),
        measured_px=np.zeros((n, 2)),
        covariance_px2=np.tile([SIGMA_PX**2, 0.0, SIGMA_PX**2], (n, 1)),
        image_count=int(max(image)) + 1,
    )


def usual() -> tuple[StarTable, Floats]:
    """Twelve images of the same thirty stars, and sound residuals."""
    image, star = np.divmod(np.arange(IMAGES * STARS), STARS)
    residual = SIGMA_PX * np.random.default_rng(1).normal(size=(len(image), 2))
    return table_of(image, star), np.clip(residual, -3.0 * SIGMA_PX, 3.0 * SIGMA_PX)


def fits(residual: Floats, table: StarTable, place_px2: float = 0.0) -> Mask:
    """Stars that fit with a variance of places, in cells that no two observations share."""
    covariance = table.covariance_px2
    return fitting_stars(residual, covariance, place_px2, table, apart(table), 4.5)


def apart(table: StarTable) -> Groups:
    return Groups('cells', np.arange(len(table)), np.arange(len(table)))


def test_an_outlier_is_left_out_alone_at_the_length_of_its_residual() -> None:
    table, residual = usual()
    u, v = 4.6 * SIGMA_PX * np.array([0.6, -0.8])
    residual[37] = u, v
    residual[111] = 4.4 * SIGMA_PX, 0.0
    assert np.flatnonzero(~fits(residual, table)).tolist() == [37]
    # A star that is seen twice cannot be told from its images.
    assert len(dropped_stars(table, fits(residual, table))) == 0


def test_what_neighbours_on_the_detector_share_is_no_outlier() -> None:
    table, residual = usual()
    residual *= 0.2  # so that the sums below are those of the bump
    # Cells of nine stars: in the first, the lens moves all by 7 sigma; one star has an error too.
    cell = np.arange(len(table)) // 9
    bump = 7.0 * SIGMA_PX * np.array([0.6, 0.8])
    residual[cell == 0] += bump
    residual[4] = -40.0 * bump
    # A lone error in the second one, and two that have nothing in common in the third.
    residual[12] += bump
    residual[[20, 23]] = bump, -bump
    cells = Groups('cells', cell, pairs_of(cell, table.star))
    kept = fitting_stars(residual, table.covariance_px2, 0.0, table, cells, 4.5)
    assert np.flatnonzero(~kept).tolist() == [4, 12, 20, 23]
    assert np.count_nonzero(~fits(residual, table)) == 9 + 3


def test_a_star_that_is_an_outlier_in_most_of_its_images_is_left_out_of_all() -> None:
    table, residual = usual()
    for star, misses in ((4, 7), (9, 6)):
        rows = np.flatnonzero(table.star == star)
        residual[rows] = 0.0
        residual[rows[:misses], 0] = 9.0 * SIGMA_PX
    kept = fits(residual, table)
    assert not kept[table.star == 4].any() and kept[table.star == 9].sum() == 6
    assert dropped_stars(table, kept).tolist() == [45]


def test_a_star_whose_residuals_together_are_too_large_is_left_out() -> None:
    table, residual = usual()
    level = math.sqrt(chi2.isf(FALSE_ALARM_RATE / STARS, 2 * IMAGES) / IMAGES) * SIGMA_PX
    for star, share in ((3, 1.02), (7, 0.98)):
        residual[table.star == star] = share * level * np.array([0.6, 0.8])
    kept = fits(residual, table)
    assert not kept[table.star == 3].any() and kept[table.star == 7].all()
    assert kept.sum() == len(table) - IMAGES
    assert dropped_stars(table, kept).tolist() == [35]


def test_a_star_of_two_images_is_not_judged_as_a_star() -> None:
    table, residual = usual()
    few = table.star.copy()
    # Star 3 only twice, star 4 three times; the others are of stars of their own.
    for star, sightings in ((3, 2), (4, 3)):
        rows = np.flatnonzero(few == star)[sightings:]
        few[rows] = few.max() + 1 + np.arange(len(rows))
    table = table_of(table.image, few)
    residual[(few == 3) | (few == 4)] = 4.4 * SIGMA_PX / math.sqrt(2.0)
    kept = fits(residual, table)
    assert kept[few == 3].all() and not kept[few == 4].any()
    assert dropped_stars(table, kept).tolist() == [45]


def test_the_variance_of_a_place_does_not_drop_good_stars() -> None:
    # All images of a star share the error of its place: their residuals are one large number.
    rng = np.random.default_rng(2)
    m, n = 60, 200
    image, star = np.divmod(np.arange(m * n), n)
    place_px2 = 3.0 * SIGMA_PX**2
    table = table_of(image, star)
    table.covariance_px2[:, [0, 2]] += place_px2
    place = math.sqrt(place_px2) * rng.normal(size=(n, 2))
    residual = place[star] + SIGMA_PX * rng.normal(size=(m * n, 2))
    kept = fits(residual, table, place_px2)
    assert kept.mean() > 0.999 and len(dropped_stars(table, kept)) == 0
    assert len(dropped_stars(table, fits(residual, table))) > 5
    # A place that is wrong beyond that variance goes.
    residual[star == 17] += [7.0 * math.sqrt(place_px2 + SIGMA_PX**2), 0.0]
    kept = fits(residual, table, place_px2)
    assert kept[star == 18].all() and not kept[star == 17].any()


def test_an_image_with_too_few_of_its_stars_is_not_used() -> None:
    table, residual = usual()
    for image, stars in ((2, FEWEST - 1), (5, FEWEST)):
        rows = np.flatnonzero(table.image == image)
        residual[rows[stars:], 1] = 50.0 * SIGMA_PX
    kept = fits(residual, table)
    assert not kept[table.image == 2].any() and kept[table.image == 5].sum() == 3
    assert kept.sum() == len(table) - 2 * STARS + 3


def judged(
    error: Floats, variance: Any = 1e-3, seen: Any = True, is_stated: bool = True
) -> list[int]:
    """Misfits among the images of one star tracker, by errors (m, 3) and variances by stars."""
    m = len(error)
    of_stars, are_seen = np.broadcast_to(variance, (m, 3)), np.broadcast_to(seen, m)
    found = misfit_images(error, of_stars, are_seen, np.zeros(m, np.int64), is_stated)
    return np.flatnonzero(found).tolist()  # type: ignore[no-any-return]


def test_few_images_of_a_star_tracker_of_unknown_noise_have_no_misfits() -> None:
    """Noise of four times the guess: three images have a scatter of any size."""
    rng = np.random.default_rng(3)
    for m in (3, 6, 12, 40):
        for _ in range(50):
            assert not judged(4.0 * rng.normal(size=(m, 3)), is_stated=False)
    error = 4.0 * rng.normal(size=(12, 3))
    error[5, 1] = 400.0  # a jump of a degree
    assert judged(error, is_stated=False) == [5]


def test_the_limit_is_six_sigma_of_the_stated_noise() -> None:
    error, variance = np.zeros((2, 9, 3))
    error[4, 1] = 5.9
    assert judged(error, variance) == []
    error[4, 1] = 6.1
    assert judged(error, variance) == [4]
    # Few stars do not show it.
    variance[4, 1] = 1.2
    assert judged(error, variance) == []


def test_the_limit_grows_with_the_scatter_of_the_images() -> None:
    error = np.clip(4.0 * np.random.default_rng(5).normal(size=(60, 3)), -10.0, 10.0)
    for largest, misfits in ((18.0, []), (40.0, [7])):
        error[7, 0] = largest
        assert judged(error) == misfits


@pytest.mark.parametrize('m', [8, 36])
def test_a_star_tracker_that_drifts_has_no_misfits(m: int) -> None:
    error = np.random.default_rng(6).normal(size=(m, 3))
    # 48 sigma from the first image to the last.
    error += np.linspace(-24.0, 24.0, m)[:, None] * [1.0, -0.5, 0.2]
    assert judged(error) == []
    error[m // 2, 2] += 40.0
    assert judged(error) == [m // 2]


def test_without_a_majority_there_is_no_misfit() -> None:
    error = np.zeros((9, 3))
    error[[0, 3, 7], 0] = [100.0, -90.0, 80.0]
    assert judged(error, 0.0) == [0, 3, 7]
    error[5, 0] = 120.0
    assert judged(error, 0.0) == []


def test_images_without_stars_enough_are_not_judged() -> None:
    error = 0.3 * np.random.default_rng(8).normal(size=(12, 3))
    error[:5] = 1e3
    error[8, 1] = 20.0
    assert judged(error, seen=np.arange(12) >= 5) == [8]
