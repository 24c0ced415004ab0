# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars identified without attitude: found where they are, refused where they are not."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bench.lost_in_space import camera, find_sky, Frame, frames
from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.identification.blind.pattern_index import (
    _SPACING,
    _STARS,
    equal_shapes,
    equivalent,
    pattern_index,
    shape_grid,
    shapes,
    sphere_points,
)
from starcal_ros.identification.blind.search import (
    confirm_sky,
    find_in_any,
    matched_again,
    mirror,
    mirrored_camera,
    NotFound,
    SkyMatch,
)
from starcal_ros.identification.blind.sky_fit import (
    _chance_of_order,
    FOUND,
    mutual,
    Ranges,
    SourceImage,
    STATED,
)
from starcal_ros.sky.catalog import load_catalog, StarCatalog


@pytest.fixture(scope='module')
def catalog() -> StarCatalog:
    return load_catalog()


@pytest.fixture(scope='module', params=[15, 55])
def frame(request: pytest.FixtureRequest, catalog: StarCatalog) -> Frame:
    """Twenty stars among ten false sources; the prior off by as much as is promised."""
    return next(frames(catalog, request.param, 20, 10, 1.0, 1))


def test_stars_are_those_drawn(frame: Frame, catalog: StarCatalog) -> None:
    found = find_sky(frame.xy_px, frame.prior, catalog)
    assert isinstance(found, SkyMatch) and not found.mirrored
    drawn = {tuple(xy): star for xy, star in zip(frame.xy_px.tolist(), frame.star, strict=True)}
    same = [
        drawn[tuple(xy)] == star
        for xy, star in zip(found.xy_px.tolist(), found.catalog_index, strict=True)
    ]
    # Twenty stars are drawn; a false source may lie beside a fainter star by chance.
    assert sum(same) >= 18 and np.mean(same) > 0.85
    # Places are 0.3 px off; seven parameters take a sixth of that from forty coordinates.
    assert 0.15 < found.residual_px < 0.5
    assert found.log10_p_value < -20
    boresight = line_of_sight(found.camera, np.array([[511.5, 409.5]])) @ np.asarray(
        found.camera_from_icrf.as_matrix()
    )
    true = frame.camera_from_icrf.as_matrix()[2]
    # The true principal point is up to 5 % of the width off the middle of the image.
    assert float(boresight[0] @ true) > math.cos(math.radians(0.06 * 55))


@pytest.mark.slow
def test_a_mirror_image_is_found_as_such(frame: Frame, catalog: StarCatalog) -> None:
    flipped = mirror(frame.xy_px, frame.prior.width)
    assert isinstance(find_sky(flipped, frame.prior, catalog), NotFound)
    found = find_sky(flipped, frame.prior, catalog, try_mirrored=True)
    assert isinstance(found, SkyMatch) and found.mirrored
    assert {tuple(xy) for xy in found.xy_px.tolist()} <= {tuple(xy) for xy in flipped.tolist()}


def test_the_selection_of_sources_that_shows_stars_is_found(
    frame: Frame, catalog: StarCatalog
) -> None:
    points = np.random.default_rng(1).uniform([0, 0], [1024, 820], (18, 2))
    found, row = find_in_any([points[:4], points, frame.xy_px], frame.prior, catalog)
    assert isinstance(found, SkyMatch) and row == 2
    alone = find_sky(frame.xy_px, frame.prior, catalog)
    assert isinstance(alone, SkyMatch)
    np.testing.assert_array_equal(found.catalog_index, alone.catalog_index)


@pytest.mark.slow
def test_random_points_are_no_stars(catalog: StarCatalog) -> None:
    points = np.random.default_rng(1).uniform([0, 0], [1024, 820], (18, 2))
    found = find_sky(points, camera(25), catalog)
    assert isinstance(found, NotFound) and 'no pattern' in found.reason


def test_four_sources_are_too_few(catalog: StarCatalog) -> None:
    found = find_sky(np.array([[1.0, 1], [50, 9], [700, 40], [99, 300]]), camera(25), catalog)
    assert isinstance(found, NotFound) and 'at least 5' in found.reason


def test_mirroring_twice_is_nothing() -> None:
    prior = camera(25).replace(cx=500.0, p2=1e-3, skew=0.5)
    again = mirrored_camera(mirrored_camera(prior))
    np.testing.assert_array_equal(again.parameters, prior.parameters)


def test_a_shape_hangs_on_no_rotation_or_order() -> None:
    rng = np.random.default_rng(2)
    directions = rng.normal([0, 0, 5], 0.3, (50, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    order, shape = shapes(directions)
    turned = Rotation.random(random_state=3).apply(directions.reshape(-1, 3)).reshape(-1, 4, 3)
    shuffled = turned[:, [2, 0, 3, 1]]
    order_again, shape_again = shapes(shuffled)
    # Rounding alone: 1e-16 by the largest ratio of lengths, some tens.
    np.testing.assert_allclose(shape_again, shape, atol=1e-12)
    np.testing.assert_array_equal(np.array([2, 0, 3, 1])[order_again], order)


def random_shapes(seed: int, count: int) -> tuple[Indices, Floats]:
    directions = np.random.default_rng(seed).normal([0, 0, 5], 0.3, (count, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    return shapes(directions)


def test_equivalent_orders_have_the_shape_of_their_stars() -> None:
    # With a tolerance beyond every shape, all four orders are near a border.
    orders, found = equivalent(*random_shapes(4, 1), 2.0)
    assert len({tuple(order) for order in orders.tolist()}) == 4
    np.testing.assert_allclose(found[2][:2], 1.0 - found[0][:2] * [1, 1] - [0, 1], atol=1e-12)


def test_the_grid_finds_what_the_definition_does() -> None:
    """Every shape within the tolerances of any order, and no other."""
    order, shape = random_shapes(5, 3000)
    grid = shape_grid(shape)
    rng = np.random.default_rng(6)
    for tolerance, size_tolerance in ((0.014, 0.3), (0.04, 0.13), (0.1, 0.2)):
        seen = shape[:40] + 1.4 * tolerance * rng.uniform(-1, 1, (40, 5))
        _, four = equivalent(order[:40], seen, 2.0)
        off = np.abs(four[:, None] - shape[None])
        close = (off[..., :4] <= tolerance).all(axis=2) & (off[..., 4] <= size_tolerance)
        expected = {(*four[k].round(9), n) for k, n in zip(*np.nonzero(close), strict=True)}
        assert len(expected) > 5
        _, near = equivalent(order[:40], seen, tolerance)
        query, found = equal_shapes(grid, near, tolerance, size_tolerance)
        # The grid keeps shapes as float32: no pair of these lies within 1e-7 of a tolerance.
        got = {(*near[k].round(9), grid.rows[n]) for k, n in zip(query, found, strict=True)}
        assert got == expected and len(query) == len(got)


def test_shapes_outside_the_grid_equal_none() -> None:
    grid = shape_grid(random_shapes(7, 100)[1])
    query, found = equal_shapes(grid, np.full((3, 5), 9.0), 0.02, 0.2)
    assert len(query) == len(found) == 0
    query, found = equal_shapes(grid, np.empty((0, 5)), 0.02, 0.2)
    assert len(query) == len(found) == 0


@pytest.mark.parametrize('scale', [1, 7])
def test_the_index_has_all_patterns_of_the_brightest_stars_of_each_disc(
    catalog: StarCatalog, scale: int
) -> None:
    index = pattern_index(catalog, scale)
    kept = set(map(tuple, np.sort(index.quads, axis=1).tolist()))
    centres = sphere_points(int(4 * math.pi / (_SPACING * index.radius_rad) ** 2))
    tree = cKDTree(catalog.direction_icrs[: index.quads.max() + 1])
    chord = 2 * math.sin(index.radius_rad / 2)
    for place in centres[:: len(centres) // 100]:
        members = sorted(tree.query_ball_point(place, 0.999999 * chord))[: _STARS[scale]]
        assert kept.issuperset(itertools.combinations(members, 4))
    order, shape = shapes(catalog.direction_icrs[index.quads[index.grid.rows]])
    same = (order == np.arange(4)).all(axis=1) & (abs(index.grid.shape - shape) < 1e-3).all(axis=1)
    assert same.mean() > 0.9999  # two orders may be equal to rounding


def test_of_stars_at_one_place_the_brightest_matches() -> None:
    image = SourceImage(np.array([[10.0, 10.0], [50.0, 50.0]]), camera(15))
    predicted_px = np.array([[50.2, 50.0], [10.0, 10.1], [50.2, 50.0]])
    rank, source, apart_px = mutual(image, predicted_px, 2.0, 10)
    assert rank.tolist() == [0, 1] and source.tolist() == [1, 0]
    np.testing.assert_allclose(apart_px, [0.2, 0.1], rtol=0, atol=1e-9)


def test_the_chance_of_an_order_is_that_among_all_permutations() -> None:
    """Kendall's distribution of pairs in the wrong order, by counting."""
    pairs = tuple(itertools.combinations(range(6), 2))
    every = itertools.permutations(range(6))
    wrong = np.array([sum(order[i] > order[j] for i, j in pairs) for order in every])
    for source, found in (
        ((0, 1, 2, 3, 4, 5), 0),
        ((3, 1, 7, 9, 20, 8), 3),
        ((9, 8, 7, 3, 2, 1), 15),
    ):
        # Rounding of five convolutions.
        expected = pytest.approx(np.mean(wrong <= found), abs=1e-14)
        assert _chance_of_order(np.array(source)) == expected


def test_points_cover_the_sphere() -> None:
    points = sphere_points(1000)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    # Even to a point: the mean of a thousand random ones would be 0.03 long.
    assert np.linalg.norm(points.mean(axis=0)) < 1e-3


@pytest.mark.parametrize('width_deg', [15, 55])
def test_a_rotation_known_roughly_is_confirmed(catalog: StarCatalog, width_deg: float) -> None:
    frame = next(
        frames(catalog, width_deg, 20, 10, 0.0, 1)
    )  # a confirmation needs the focal length
    off = Rotation.from_euler('xz', [0.05 * width_deg, 3.0], degrees=True)
    found = confirm_sky(frame.xy_px, frame.prior, catalog, off * frame.camera_from_icrf)
    searched = find_sky(frame.xy_px, frame.prior, catalog)
    assert isinstance(found, SkyMatch) and isinstance(searched, SkyMatch)
    # Both fit the twenty stars drawn, from other starts; two may stand beside false sources.
    assert len(set(found.catalog_index) & set(searched.catalog_index)) >= 18
    elsewhere = Rotation.from_euler('y', 90.0, degrees=True) * frame.camera_from_icrf
    assert isinstance(confirm_sky(frame.xy_px, frame.prior, catalog, elsewhere), NotFound)


@pytest.mark.parametrize('width_deg', [8, 25, 55])
@pytest.mark.parametrize(('ranges', 'growth', 'is_found'), [
    (FOUND, 1.0, True),
    (FOUND, 1.008, True),
    (FOUND, 1.1, False),
    (STATED, 1.1, True),
])  # fmt: skip
def test_a_camera_that_identified_another_image_is_searched_near_its_focal_length(
    catalog: StarCatalog, width_deg: float, ranges: Ranges, growth: float, is_found: bool
) -> None:
    frame = next(frames(catalog, width_deg, 20, 10, 0.0, 1))
    fx = growth * float(frame.prior.parameters[0])
    prior = frame.prior.replace(fx=fx, fy=fx)
    sky, _ = find_in_any([frame.xy_px], prior, catalog, ranges=ranges)
    assert isinstance(sky, SkyMatch) == is_found
    if isinstance(sky, SkyMatch):
        apart = (sky.camera_from_icrf * frame.camera_from_icrf.inv()).magnitude()
        assert apart * fx < 20.0  # px; the principal point is fitted too


@pytest.mark.parametrize('mirrored', [False, True])
def test_a_better_camera_matches_the_stars_that_one_image_left_out(
    catalog: StarCatalog, mirrored: bool
) -> None:
    frame = next(frames(catalog, 25, 40, 10, 0.0, 1))
    xy_px = mirror(frame.xy_px, frame.prior.width) if mirrored else frame.xy_px
    sky = find_sky(xy_px, frame.prior, catalog, try_mirrored=True)
    assert isinstance(sky, SkyMatch) and sky.mirrored == mirrored
    few = dataclasses.replace(sky, catalog_index=sky.catalog_index[:9], xy_px=sky.xy_px[:9])
    again = matched_again(few, xy_px, catalog, frame.prior, frame.camera_from_icrf)
    drawn = {tuple(xy): star for xy, star in zip(xy_px.tolist(), frame.star, strict=True)}
    rows = zip(again.xy_px.tolist(), again.catalog_index, strict=True)
    assert sum(drawn[tuple(xy)] == star for xy, star in rows) >= 38
    assert again.camera is frame.prior and again.mirrored == mirrored


def test_bright_false_sources_do_not_hide_the_stars(catalog: StarCatalog) -> None:
    """As in a corona: at large radii of matching, most stars are near a source by chance."""
    confirmed = 0
    for frame in frames(catalog, 55, 60, 100, 0.0, 10):
        brightest = np.flatnonzero(frame.star < 0)[-30:]
        order = np.concatenate([brightest, np.setdiff1d(np.arange(len(frame.star)), brightest)])
        off = Rotation.from_euler('xz', [1.6, 2.0], degrees=True)
        guess = off * frame.camera_from_icrf
        found = confirm_sky(frame.xy_px[order], frame.prior, catalog, guess)
        confirmed += isinstance(found, SkyMatch)
    # Six of ten; ten of the forty brightest sources are stars, and their shift must be found.
    # Judged by chance from the first radius on, four.
    assert confirmed >= 6


def test_a_catalog_too_small_for_a_pattern_identifies_nothing(catalog: StarCatalog) -> None:
    frame = next(frames(catalog, 20, 20, 10, 0.0, 1))
    few = catalog.select(np.arange(49))
    assert isinstance(find_sky(frame.xy_px, frame.prior, few, try_mirrored=True), NotFound)


@pytest.mark.parametrize(
    ('model', 'parameters', 'half_deg'),
    [
        # The focal length alone would put the corners beyond 90 degrees, where a tangent is
        # negative, and every patch of the sky was searched for 100 s.
        ('equidistant', [314.0, 0.0, 314.0, 399.5, 319.5, 0.29, 0.25, -0.1, 0.17], 58.0),
        ('plumb_bob', [700.0, 0.0, 700.0, 399.5, 319.5, 0.0, 0.0, 0.0, 0.0, 0.0], 36.2),
        ('equidistant', [280.0, 0.0, 280.0, 399.5, 319.5, 0.0, 0.0, 0.0, 0.0], 80.0),
    ],
)
def test_half_of_the_diagonal_is_that_of_the_lens(
    model: str, parameters: list[float], half_deg: float
) -> None:
    image = SourceImage(np.empty((0, 2)), CameraModel(800, 640, np.array(parameters), model))
    # The corners of the first lens are 58 degrees off by its series, to half a degree.
    assert math.degrees(image.half_diagonal_rad) == pytest.approx(half_deg, abs=0.6)
