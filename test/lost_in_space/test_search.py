# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars identified without attitude: found where they are, refused where they are not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.lost_in_space import camera, Frame, frames
from starcal_ros.camera import line_of_sight
from starcal_ros.lost_in_space.pattern_index import equivalent, shapes, sphere_points
from starcal_ros.lost_in_space.search import (
    confirm_sky,
    find_sky,
    mirror,
    mirrored_camera,
    NotFound,
    SkyMatch,
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


def test_a_mirror_image_is_found_as_such(frame: Frame, catalog: StarCatalog) -> None:
    flipped = mirror(frame.xy_px, frame.prior.width)
    assert isinstance(find_sky(flipped, frame.prior, catalog), NotFound)
    found = find_sky(flipped, frame.prior, catalog, try_mirrored=True)
    assert isinstance(found, SkyMatch) and found.mirrored
    assert {tuple(xy) for xy in found.xy_px.tolist()} <= {tuple(xy) for xy in flipped.tolist()}


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


def test_equivalent_orders_have_the_shape_of_their_stars() -> None:
    rng = np.random.default_rng(4)
    directions = rng.normal([0, 0, 5], 0.3, (1, 4, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    orders, found = equivalent(*shapes(directions))
    assert len({tuple(order) for order in orders.tolist()}) == 4
    np.testing.assert_allclose(found[2][:2], 1.0 - found[0][:2] * [1, 1] - [0, 1], atol=1e-12)


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
