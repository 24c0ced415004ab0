# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Pictures: of the image's size, with stars where they are, whatever the image holds."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.pipeline.annotation import annotate, predicted_px, STAR_MARKS, stretch
from starcal_ros.records import (
    CameraGeometry,
    Image,
    refused_image,
    STAR_REFUSALS,
    StarObservations,
)

PIXELS = np.array([[30.0, 40.0], [150.25, 99.5]])
GEOMETRY = CameraGeometry(
    CameraModel(200, 120, np.array([400.0, 0, 400.0, 99.5, 59.5, -0.1, 0, 0, 0, 0])),
    np.array([0.0, 0.0, np.sin(0.2), np.cos(0.2)]),
)


def two_stars() -> StarObservations:
    """Observations of two stars exactly where the geometry puts them."""
    in_camera = line_of_sight(GEOMETRY.camera, PIXELS)
    return dataclasses.replace(
        StarObservations.of_image(0, (200, 120)),
        catalog_id=np.array([1, 2]),
        direction_icrf=Rotation.from_rotvec([0.0, 0.0, 0.4]).apply(in_camera),
        magnitude=np.zeros(2, np.float32),
        measured_px=PIXELS,
        covariance_px2=np.ones((2, 3)),
        flux_dn=np.ones(2, np.float32),
        snr=np.array([5.0, 500.0], np.float32),
        refused_stars={'blend': 3, 'faint': 0},
    )


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
def test_marks_stand_at_the_stars(dtype: Any) -> None:
    np.testing.assert_allclose(predicted_px(two_stars(), GEOMETRY), PIXELS, atol=1e-9)
    plain = Image(0, np.full((120, 200), 7, dtype))
    empty = annotate(plain, StarObservations.of_image(0, (200, 120)), GEOMETRY)
    picture = annotate(plain, two_stars(), GEOMETRY)
    assert picture.shape == (120, 200, 3) and picture.dtype == np.uint8
    changed = (picture != empty).any(axis=2)
    for u, v in PIXELS.round().astype(int):
        assert changed[v - 12 : v + 13, u - 12 : u + 13].any()
    assert not changed[60:, :60].any()


def test_flat_images_have_a_picture_and_faint_stars_are_seen() -> None:
    for value, dtype in ((0, np.uint16), (255, np.uint8), (65535, np.uint16)):
        picture = stretch(np.full((3, 5), value, dtype))
        assert picture.dtype == np.uint8 and np.ptp(picture) == 0
    pixels = np.random.default_rng(1).normal(100, 3, (300, 300)).astype(np.uint16)
    pixels[150, 150] = 160
    pixels[10, 10] = 65535
    picture = stretch(pixels)
    assert picture[150, 150] > np.median(picture) + 40
    assert picture[10, 10] in (240, 255)


def test_predictions_far_outside_are_drawn_over() -> None:
    away = np.array([[0, 0, -1.0], [1, 0, 1e-9]])
    behind = dataclasses.replace(two_stars(), direction_icrf=away)
    assert annotate(Image(0, np.zeros((120, 200), np.uint8)), behind, GEOMETRY).any()


def test_every_reason_has_a_mark_of_its_own() -> None:
    assert set(STAR_MARKS) == set(STAR_REFUSALS)
    assert len({(mark.shape, mark.color) for mark in STAR_MARKS.values()}) == len(STAR_MARKS)


def test_refused_stars_are_marked_by_reason() -> None:
    """Each stands at its place in the colour of its reason, which the legend shows again."""
    shown = dataclasses.replace(
        StarObservations.of_image(0, (1000, 600)),
        refused_stars={'blend': 1, 'of another version': 1, 'saturated': 0},
        refused_catalog_id=np.array([5, 6]),
        refused_px=np.array([[700.0, 400.0], [800.0, 500.0]], np.float32),
        refused_reason=np.array([0, 1], np.uint8),
    )
    picture = annotate(Image(0, np.zeros((600, 1000), np.uint8)), shown, GEOMETRY)
    v, u = np.nonzero((picture == STAR_MARKS['blend'].color).all(axis=2))
    at_star = (np.abs(u - 700) < 10) & (np.abs(v - 400) < 10)
    in_legend = (u < 30) & (v < 100)
    assert at_star.any() and in_legend.any() and (at_star | in_legend).all()
    assert (picture[490:510, 790:810] == 255).all(axis=2).any()
    assert not (picture == STAR_MARKS['saturated'].color).all(axis=2).any()


def test_a_refusal_is_in_red_and_wrapped_where_it_is_long() -> None:
    image = Image(0, np.zeros((120, 200), np.uint8))
    short, long = (
        annotate(image, refused_image(0, 200, 120, 'no_match', text), GEOMETRY)
        for text in ('three', 'of a detail that needs lines and lines ' * 3)
    )
    red = [(picture[:, -1] == (40, 40, 200)).all(axis=1).sum() for picture in (short, long)]
    assert red[1] > red[0] > 0
