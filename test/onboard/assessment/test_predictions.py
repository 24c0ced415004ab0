# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Predictions of images, stars and cells by the others, and the residuals that are left."""

from collections.abc import Callable
import dataclasses
import functools
import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from worlds import displaced, each_image, estimated, observed, of_random_pointings, WIDTH  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats, Mask
from starcal_ros.assessment import predictions as predictions_module
from starcal_ros.assessment.predictions import predicted_residuals, predictions
from starcal_ros.camera import line_of_sight, project
from starcal_ros.estimation.star_equations import whitening
from starcal_ros.records import Ensemble, ResidualBin, StarObservations
from studies.worlds import ripple

MIDDLE_PX = np.array([647.5, 511.5])


def bins_of(given: Scenario, ensemble: Ensemble) -> list[ResidualBin]:
    return list(predictions(estimated(given, ensemble)))


def worst_of(bins: list[ResidualBin]) -> ResidualBin:
    """The part that is farthest above 1 in its sigma."""
    return max(bins, key=lambda one: (one.normalised - 1.0) / one.sigma)


def without_image(given: Scenario, ensemble: Ensemble, k: int) -> Floats:
    """Whitened residuals (2, n) of image k under a calibration of the others."""
    others = Ensemble(tuple(one for i, one in enumerate(ensemble.images) if i != k))
    found = estimated(given, others, variance_components=False)
    image, camera = ensemble.images[k], found.geometry.camera
    time_s = found.linear.problem.time_s
    late_s = time_s[0] + (image.time_ns - others.images[0].time_ns) * 1e-9
    trend_px = found.posterior.mean[found.linear.layout.of(['trend'])].item()
    scale = 1.0 + trend_px * late_s / math.sqrt((time_s**2).mean()) / camera.parameters[0]
    fx, skew, fy = (scale * camera.parameters[:3]).tolist()
    camera = camera.replace(fx=fx, skew=skew, fy=fy)
    wuu, wuv, wvv = whitening(image.covariance_px2)
    start = given.truth.icrf_from_camera(image.icrf_from_star_tracker_xyzw).inv()

    def whitened(rotvec: Floats) -> Floats:
        seen = (Rotation.from_rotvec(rotvec) * start).apply(image.direction_icrf)
        u, v = (image.measured_px - project(camera, seen)).T
        return np.concatenate([wuu * u + wuv * v, wvv * v])

    return np.asarray(whitened(least_squares(whitened, np.zeros(3), xtol=1e-14).x).reshape(2, -1))


def test_the_linear_step_is_the_calibration_without_the_image() -> None:
    given, ensemble = observed(12, images=5)
    found = estimated(given, ensemble, variance_components=False, outlier_sigma=20.0)
    squared, expected = predicted_residuals(found)
    for k in (0, 3):
        inside = (found.table.image == k) & found.kept
        assert inside.sum() == len(ensemble.images[k].measured_px)
        exact = (without_image(given, ensemble, k) ** 2).sum(axis=0)
        # The amplitudes without the image are others, and the star tracker holds its rotation.
        np.testing.assert_allclose(np.sqrt(squared[inside]), np.sqrt(exact), atol=0.1)
    # Two a star, less the own rotation of five images, more the calibration of four.
    assert abs(expected[found.kept].mean() - 2.0) < 0.03


def test_an_image_is_predicted_by_the_formula_of_the_module() -> None:
    """Dense inverses on random numbers; the residuals have a part that the image follows."""
    rng = np.random.default_rng(11)
    J, K, r = rng.normal(size=(40, 5)), rng.normal(size=(40, 6)), rng.normal(size=40)
    W = np.diag([0.0, 0.0, 0.0, 30.0, 40.0, 50.0])
    G = np.eye(40) - K @ np.linalg.inv(K.T @ K + W) @ K.T
    N = J.T @ G @ J + np.diag([2.0, 3.0, 5.0, 7.0, 11.0])
    V, half = rng.uniform(0.2, 1.0, 40), rng.normal(size=(5, 5))
    E = 0.1 * half @ half.T
    predicted = predictions_module._predicted(J, K, r, V, N, W, E)
    assert predicted is not None
    by_others = np.linalg.inv(N - J.T @ G @ J)
    left = G @ r + G @ J @ by_others @ J.T @ G @ r
    own = G + G @ (np.diag(V) - np.eye(40)) @ G
    variance = np.diag(own + G @ J @ (by_others + E) @ J.T @ G)
    for found, expected in zip(predicted, (left**2, variance), strict=True):
        np.testing.assert_allclose(found, expected[:20] + expected[20:], rtol=1e-10)


def test_a_sound_camera_is_as_predicted_in_every_part() -> None:
    bins = bins_of(*observed(13, images=6))
    assert {'radius', 'magnitude', 'image', 'cell'} <= {one.by for one in bins}
    for one in bins:
        # Twenty parts: one exceeds 3.5 sigma in 1 of 100 campaigns.  Bright stars share the error
        # of the five images that predict theirs: of 12 campaigns one had 1.09.
        assert abs(one.normalised - 1.0) < 3.5 * one.sigma + 0.05, one


def test_images_are_grouped_by_their_time_in_any_order() -> None:
    given, ensemble = observed(3, images=6)
    turned = Ensemble(tuple(reversed(ensemble.images)))
    one, other = (
        [one.normalised for one in bins_of(given, images) if one.by == 'image']
        for images in (ensemble, turned)
    )
    assert len(one) > 1 and one == pytest.approx(other, rel=1e-6)


def test_few_images_are_not_predicted() -> None:
    assert bins_of(*observed(13, images=3)) == []


def torn(ensemble: Ensemble, size_px: float = 0.3) -> Ensemble:
    """The ensemble whose last image has a shape of its own, as of a shutter that sticks."""
    last = ensemble.images[-1]
    along = (last.measured_px[:, 0] / WIDTH - 0.5) * 8.0
    moved_px = last.measured_px + size_px * np.stack([np.sin(along), 0.0 * along], axis=-1)
    return Ensemble((*ensemble.images[:-1], dataclasses.replace(last, measured_px=moved_px)))


Part = Callable[[int, StarObservations], 'Mask | bool']


def scattered(ensemble: Ensemble, part: Part) -> Ensemble:
    """The ensemble whose stars in a part have errors of two more sigma."""
    rng = np.random.default_rng(14)

    def worse(k: int, image: StarObservations) -> dict[str, Floats]:
        more_px = 2.0 * np.sqrt(image.covariance_px2[:, [0, 2]]) * rng.normal(size=(len(image), 2))
        inside = np.broadcast_to(part(k, image), len(image))
        return {'measured_px': image.measured_px + inside[:, None] * more_px}

    return each_image(ensemble, worse)  # type: ignore[no-any-return]


def in_the_corners(_: int, image: StarObservations) -> Mask:
    return np.asarray(np.linalg.norm(image.measured_px - MIDDLE_PX, axis=1) > 560.0)


def of_a_cell(_: int, image: StarObservations) -> dict[str, Floats]:
    inside = (np.abs(image.measured_px - [980.0, 580.0]) < 80.0).all(axis=1)
    return {'measured_px': image.measured_px + np.outer(inside, [0.3, 0.0])}


def of_faint_stars(_: int, image: StarObservations) -> dict[str, Floats]:
    return {'measured_px': image.measured_px + np.outer(image.magnitude > 7.2, [0.1, 0.0])}


FAULTS: dict[str, tuple[str, Callable[[Ensemble], Ensemble]]] = {
    'a PSF that is wrong in the corners': ('radius', lambda e: scattered(e, in_the_corners)),
    'images of a bad night': ('image', lambda e: scattered(e, lambda k, _: k >= 9)),
    'a region of the detector 0.3 px off': ('cell', lambda e: each_image(e, of_a_cell)),
    'faint stars 0.1 px off': ('brightness', lambda e: each_image(e, of_faint_stars)),
    'an image with a shape of its own': ('image', lambda e: torn(e, 0.4)),
}


@pytest.mark.parametrize('fault', FAULTS)
def test_a_fault_is_seen_in_its_part(fault: str) -> None:
    (given, ensemble), (by, made) = observed(16), FAULTS[fault]
    bins = bins_of(given, made(ensemble))
    worst, of_kind = worst_of(bins), [one for one in bins if one.by == by]
    assert worst.by == by and worst.normalised > 1.0 + 5.0 * worst.sigma
    if by in ('radius', 'image'):
        assert worst is of_kind[-1] and of_kind[0].normalised < 1.1


def test_without_a_fault_no_part_stands_apart() -> None:
    """Nor do faint stars of a wrong noise, since a change with magnitude is estimated."""
    given, ensemble = observed(16)
    worst = worst_of(bins_of(given, ensemble))
    assert worst.normalised < 1.0 + 3.5 * worst.sigma
    noisy = scattered(ensemble, lambda _, image: image.magnitude > 7.5)
    assert max(one.normalised for one in bins_of(given, noisy)) < 1.1


def of_images(bins: list[ResidualBin]) -> list[ResidualBin]:
    return [one for one in bins if one.by in ('radius', 'magnitude', 'image')]


def test_few_images_of_a_lens_with_structure_are_predicted() -> None:
    """Less an image, information is nearly singular: in the mean over amplitudes, not the mode."""
    given, ensemble = observed(21, images=5)

    def move(pixels: Floats) -> Floats:
        half_widths = (pixels - MIDDLE_PX) / (WIDTH / 2.0)
        return ripple(0.15, 14.0, np.random.default_rng(21), half_widths)

    ensemble = displaced(ensemble, move)
    sound = of_images(bins_of(given, ensemble))
    assert len(sound) >= 11
    assert all(0.85 < one.normalised < 1.15 for one in sound)
    worst = worst_of(of_images(bins_of(given, torn(ensemble, 0.6))))
    assert (worst.by, worst.high) == ('image', 4.0)
    assert worst.normalised > 1.2


@functools.cache
def of_three_fields() -> tuple[Scenario, Ensemble]:
    """Fifteen images of three fields, whose catalog places are off by 0.1 px."""
    given = of_random_pointings(17, images=3)
    fields = given.pointing.attitudes_deg * 5
    given = dataclasses.replace(
        given, image_count=15, pointing=dataclasses.replace(given.pointing, attitudes_deg=fields)
    )
    rng = np.random.default_rng(17)
    ensemble = true_observations(given)
    focal_px = float(given.truth.camera.parameters[0])
    off = {
        one: rng.normal(size=3) * 0.1 / focal_px
        for image in ensemble.images
        for one in image.catalog_id.tolist()
    }

    def moved(_: int, image: StarObservations) -> dict[str, Floats]:
        seen = line_of_sight(given.truth.camera, image.measured_px)
        turn = np.array([off[one] for one in image.catalog_id.tolist()])
        return {'measured_px': project(given.truth.camera, seen + turn)}

    return given, each_image(ensemble, moved)


def test_an_image_is_predicted_where_stars_come_again() -> None:
    """The weights are lowered for what images share, the noise of an image is not."""
    given, ensemble = of_three_fields()
    assert all(0.85 < one.normalised < 1.15 for one in of_images(bins_of(given, ensemble)))
    worst = worst_of(bins_of(given, torn(ensemble, 0.8)))
    assert worst.by == 'image' and worst.high == 14.0
    assert worst.normalised > 1.0 + 4.0 * worst.sigma


def test_places_of_stars_that_the_model_has_are_no_fault() -> None:
    """Off by 0.3 arcsec in all images; without that variance sums of a star exceed the noise."""
    found = estimated(*of_three_fields())
    bins = [one for one in predictions(found) if one.by == 'star']
    assert bins and max(one.normalised for one in bins) < 1.15
    unshared = tuple(
        dataclasses.replace(one, share_px2=0.0 * one.share_px2) if one.of_star else one
        for one in found.weights.errors
    )
    weights = dataclasses.replace(found.weights, errors=unshared)
    blind = predictions(dataclasses.replace(found, weights=weights))
    assert min(one.normalised for one in blind if one.by == 'star') > 1.3
