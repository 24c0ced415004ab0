# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars identified without attitude: found where they are, refused where they are not."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from bench.lost_in_space import camera, find_sky, Frame, frames
from starcal_ground.blind.pattern_index import (
    _SPACING,
    _STARS,
    equal_patterns,
    equivalent,
    pattern_grid,
    pattern_index,
    Patterns,
    patterns_of,
    scales_for,
    sphere_points,
)
from starcal_ground.blind.search import (
    confirm_sky,
    find_in_any,
    matched_again,
    mirror,
    mirrored_camera,
    SkyMatch,
)
from starcal_ground.blind.sky_fit import _chance_of_order, FOUND, mutual, SourceImage, STATED
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.camera.lens import LENSES
from starcal_ros.sky.catalog import load_catalog, StarCatalog


@pytest.fixture(scope='module')
def catalog() -> StarCatalog:
    return load_catalog()


@pytest.fixture(scope='module', params=[15, 55])
def frame(request: pytest.FixtureRequest, catalog: StarCatalog) -> Frame:
    """Twenty stars among ten false sources; the prior off by as much as is promised."""
    return next(frames(catalog, request.param, 20, 10, 1.0, 1))


def test_stars_are_those_drawn(frame, catalog) -> None:
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
def test_a_mirror_image_is_found_as_such(catalog) -> None:
    frame = next(frames(catalog, 15, 20, 10, 1.0, 1))
    flipped = mirror(frame.xy_px, frame.prior.width)
    assert find_sky(flipped, frame.prior, catalog) is None
    found = find_sky(flipped, frame.prior, catalog, try_mirrored=True)
    assert isinstance(found, SkyMatch) and found.mirrored
    assert {tuple(xy) for xy in found.xy_px.tolist()} <= {tuple(xy) for xy in flipped.tolist()}


def test_the_selection_of_sources_that_shows_stars_is_found(frame, catalog) -> None:
    points = np.random.default_rng(1).uniform([0, 0], [1024, 820], (18, 2))
    found, row = find_in_any([points[:4], points, frame.xy_px], [frame.prior], catalog)
    assert isinstance(found, SkyMatch) and row == 2
    alone = find_sky(frame.xy_px, frame.prior, catalog)
    assert isinstance(alone, SkyMatch)
    np.testing.assert_array_equal(found.catalog_index, alone.catalog_index)


@pytest.mark.slow
def test_random_points_are_no_stars(catalog) -> None:
    points = np.random.default_rng(1).uniform([0, 0], [1024, 820], (18, 2))
    assert find_sky(points, camera(25), catalog) is None


def test_too_few_sources_or_stars_of_a_catalog_identify_nothing(catalog) -> None:
    four_px = np.array([[1.0, 1], [50, 9], [700, 40], [99, 300]])
    assert find_sky(four_px, camera(25), catalog) is None
    frame = next(frames(catalog, 20, 20, 10, 0.0, 1))
    few = catalog.select(np.arange(49))
    assert find_sky(frame.xy_px, frame.prior, few, try_mirrored=True) is None


@pytest.mark.parametrize('model', LENSES)
def test_a_mirrored_camera_sees_mirrored_stars(model: str) -> None:
    lens = 1e-3 * np.arange(1, len(LENSES[model].coefficients) + 1)
    plain = camera(25).replace(cx=500.0, skew=0.5)
    prior = CameraModel(1024, 820, np.concatenate([plain.parameters[:5], lens]), model)
    pixels = np.random.default_rng(1).uniform([0, 0], [1024, 820], (18, 2))
    mirrored = line_of_sight(prior, pixels) * [-1.0, 1.0, 1.0]
    seen = project(mirrored_camera(prior), mirrored)
    expected_px = mirror(pixels, prior.width)
    np.testing.assert_allclose(seen, expected_px, rtol=0, atol=1e-8)  # where Newton's method ends


def random_fours(seed: int, count: int) -> Floats:
    """Directions (count, 4, 3) of four stars within some 10 degrees."""
    directions = np.random.default_rng(seed).normal([0, 0, 5], 0.3, (count, 4, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=2, keepdims=True))


def of_fours(directions: Floats) -> Patterns:
    """The pattern of each four of directions (n, 4, 3)."""
    patterns = patterns_of(directions.T, np.arange(len(directions)))
    return patterns[np.argsort(patterns['group'])]


def numbers(patterns: Patterns) -> Floats:
    """The five numbers (n, 5) of the shapes of patterns."""
    places = patterns['places']
    return np.column_stack([places.view(np.float32), patterns['size']]).astype(np.float64)


def test_a_shape_hangs_on_no_rotation_or_order_and_has_equivalent_orders() -> None:
    directions = random_fours(2, 50)
    patterns = of_fours(directions)
    turned = Rotation.random(random_state=3).apply(directions.reshape(-1, 3)).reshape(-1, 4, 3)
    again = of_fours(turned[:, [2, 0, 3, 1]])
    # Rounding to float32, places being below one and the logarithms below three.
    np.testing.assert_allclose(numbers(again), numbers(patterns), rtol=0, atol=3e-7)
    np.testing.assert_array_equal(np.array([2, 0, 3, 1])[again['order']], patterns['order'])
    # With a tolerance beyond every shape, all four orders are near a border.
    every = equivalent(of_fours(random_fours(4, 1)), 2.0)
    assert len({tuple(order) for order in every['order'].tolist()}) == 4
    np.testing.assert_array_equal(every['places'][2], -every['places'][0])


def test_the_grid_finds_what_the_definition_does() -> None:
    """Every shape within the tolerances of any order, and no other; outside of it none."""
    patterns = of_fours(random_fours(5, 3000))
    grid = pattern_grid([patterns])
    kept = numbers(grid.patterns)
    rng = np.random.default_rng(6)
    for tolerance, size_tolerance in ((0.014, 0.3), (0.04, 0.13), (0.1, 0.2)):
        shown = patterns[:40].copy()
        off = 1.4 * tolerance * rng.uniform(-1, 1, (40, 5)).astype(np.float32)
        shown['places'].view(np.float32)[:] += off[:, :4]
        shown['size'] += off[:, 4]
        four = numbers(equivalent(shown, 2.0))
        apart = np.abs(four[:, None] - kept[None])
        close = (apart[..., :4] <= tolerance).all(axis=2) & (apart[..., 4] <= size_tolerance)
        expected = {(*four[k], n) for k, n in zip(*np.nonzero(close), strict=True)}
        assert len(expected) > 5
        near = equivalent(shown, tolerance)
        query, row = equal_patterns(grid, near, tolerance, size_tolerance)
        # Differences are of float32: none of these lies within 1e-7 of a tolerance.
        got = {(*numbers(near)[k], n) for k, n in zip(query, row, strict=True)}
        assert got == expected and len(query) == len(got)
    outside = patterns[:3].copy()
    outside['places'] = 9.0 + 9.0j
    for shown in (outside, outside[:0]):
        query, row = equal_patterns(grid, shown, 0.02, 0.2)
        assert len(query) == len(row) == 0


def test_points_cover_the_sphere() -> None:
    points = sphere_points(1000)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    # Even to a point: the mean of a thousand random ones would be 0.03 long.
    assert np.linalg.norm(points.mean(axis=0)) < 1e-3


@pytest.mark.parametrize('scale', [1, 7])
def test_the_index_has_all_patterns_of_the_brightest_stars_of_each_disc(catalog, scale) -> None:
    index = pattern_index(catalog, scale)
    patterns = index.grid.patterns
    quads = index.stars(np.arange(len(patterns)))
    centres = sphere_points(int(4 * math.pi / (_SPACING * index.radius_rad) ** 2))
    tree = cKDTree(catalog.direction_icrs[: quads.max() + 1])
    chord = 2 * math.sin(index.radius_rad / 2)
    inside = tree.query_ball_point(centres[:: len(centres) // 100], 0.999999 * chord)
    members = [sorted(rows)[: _STARS[scale]] for rows in inside]
    expected = {four for rows in members for four in itertools.combinations(rows, 4)}
    ascending = np.sort(quads[np.isin(quads, list(itertools.chain(*members))).all(axis=1)], axis=1)
    assert expected <= set(map(tuple, ascending.tolist()))
    same = []
    for first in range(0, len(quads), 20_000):
        part = slice(first, first + 20_000)
        again = of_fours(catalog.direction_icrs[quads[part]])
        off = numbers(again) - numbers(patterns[part])
        same.append((again['order'] == np.arange(4)).all(axis=1) & (abs(off) < 1e-3).all(axis=1))
    assert np.concatenate(same).mean() > 0.9999  # two orders may be equal to rounding


def test_a_deep_catalog_of_the_whole_sky_has_an_index_of_bounded_size() -> None:
    """Of 400,000 stars: with seven in each disc there were 4.4 million patterns."""
    count, rng = 400_000, np.random.default_rng(4)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    bundled = load_catalog().select(np.zeros(count, np.int64))
    sky = dataclasses.replace(
        bundled,
        id=np.arange(count),
        ra_rad=np.arctan2(directions[:, 1], directions[:, 0]) % (2 * math.pi),
        dec_rad=np.arcsin(directions[:, 2]),
        magnitude=np.linspace(3.0, 11.0, count).astype(np.float64),
    )
    frame = next(frames(sky, 1.5, 20, 10, 1.0, 1))
    found = find_sky(frame.xy_px, frame.prior, sky)
    assert isinstance(found, SkyMatch)
    (scale, *_) = scales_for(SourceImage(frame.xy_px, frame.prior).half_diagonal_rad)
    assert 1_000_000 < len(pattern_index(sky, scale).grid.patterns) <= 3_000_000


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


@pytest.mark.parametrize('width_deg', [15, 55])
def test_a_rotation_known_roughly_is_confirmed(catalog, width_deg) -> None:
    # A confirmation needs the focal length.
    frame = next(frames(catalog, width_deg, 20, 10, 0.0, 1))
    off = Rotation.from_euler('xz', [0.05 * width_deg, 3.0], degrees=True)
    found = confirm_sky(frame.xy_px, frame.prior, catalog, off * frame.camera_from_icrf)
    searched = find_sky(frame.xy_px, frame.prior, catalog)
    assert isinstance(found, SkyMatch) and isinstance(searched, SkyMatch)
    # Both fit the twenty stars drawn, from other starts; two may stand beside false sources.
    assert len(set(found.catalog_index) & set(searched.catalog_index)) >= 18
    elsewhere = Rotation.from_euler('y', 90.0, degrees=True) * frame.camera_from_icrf
    assert confirm_sky(frame.xy_px, frame.prior, catalog, elsewhere) is None


@pytest.mark.parametrize('width_deg', [8, 55])
@pytest.mark.parametrize(('ranges', 'growth', 'is_found'), [
    (FOUND, 1.0, True),
    (FOUND, 1.008, True),
    (FOUND, 1.1, False),
    (STATED, 1.1, True),
])  # fmt: skip
def test_a_camera_that_identified_another_image_is_searched_near_its_focal_length(
    catalog, width_deg, ranges, growth, is_found
) -> None:
    frame = next(frames(catalog, width_deg, 20, 10, 0.0, 1))
    fx = growth * float(frame.prior.parameters[0])
    prior = frame.prior.replace(fx=fx, fy=fx)
    sky, _ = find_in_any([frame.xy_px], [prior], catalog, ranges=ranges)
    assert isinstance(sky, SkyMatch) == is_found
    if isinstance(sky, SkyMatch):
        apart = (sky.camera_from_icrf * frame.camera_from_icrf.inv()).magnitude()
        assert apart * fx < 20.0  # px; the principal point is fitted too


@pytest.mark.parametrize('mirrored', [False, True])
def test_a_better_camera_matches_the_stars_that_one_image_left_out(catalog, mirrored) -> None:
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


def test_bright_false_sources_do_not_hide_the_stars(catalog) -> None:
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
def test_half_of_the_diagonal_is_that_of_the_lens(model, parameters, half_deg) -> None:
    image = SourceImage(np.empty((0, 2)), CameraModel(800, 640, np.array(parameters), model))
    # The corners of the first lens are 58 degrees off by its series, to half a degree.
    assert math.degrees(image.half_diagonal_rad) == pytest.approx(half_deg, abs=0.6)
