# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The public functions: from arrays, from a bag, lines of sight, and how they refuse bad input."""

import dataclasses
from typing import Any

from mission_files import write_pngs  # type: ignore[import-not-found]
import numpy as np
import pytest
from tiny_campaign import ensemble, SCENARIO  # type: ignore[import-not-found]
from worlds import each_image  # type: ignore[import-not-found]

import starcal_ground
import starcal_ros
from starcal_ros.assessment import lookup
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import StarObservations

SIGMA_ARCSEC = (10.0, 10.0, 40.0)


def arrays(image: StarObservations) -> dict[str, Any]:
    uu, uv, vv = image.covariance_px2.T
    return {
        'time_ns': image.time_ns,
        'measured_px': image.measured_px,
        'covariance_px2': np.array([[uu, uv], [uv, vv]]).transpose(2, 0, 1),
        'direction_icrf': image.direction_icrf,
        'icrf_from_star_tracker_xyzw': image.icrf_from_star_tracker_xyzw,
        'catalog_id': image.catalog_id,
        'star_tracker_rate_rad_s': image.star_tracker_rate_rad_s,
        'star_tracker_rate_sigma_rad_s': image.star_tracker_rate_sigma_rad_s,
        'velocity_sigma_m_s': image.velocity_sigma_m_s,
    }


def test_public_names_are_those_that_can_be_imported() -> None:
    assert set(starcal_ros.__all__) < set(starcal_ground.__all__)
    for package in (starcal_ros, starcal_ground):
        assert set(dir(package)) >= set(package.__all__)
        for name in package.__all__:
            assert getattr(package, name) is getattr(starcal_ground, name)
        with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
            _ = package.calibrat
    assert starcal_ros.__version__.count('.') == 2


@pytest.mark.parametrize('name', ['calibrate', 'calibrate_bag', 'write_calibration'])
def test_an_old_name_leads_to_the_new_one(name) -> None:
    with pytest.raises(ImportError, match=f'^starcal_ros.{name} is starcal_ground.{name} now$'):
        exec(f'from starcal_ros import {name}')


@pytest.mark.slow
def test_arrays_give_the_estimate_of_the_records() -> None:
    images = [
        starcal_ground.observations_of(SCENARIO.prior.camera, **arrays(image))
        for image in ensemble().images
    ]
    found = starcal_ground.calibrate(
        images, SCENARIO.prior, star_tracker_sigma_arcsec=SIGMA_ARCSEC
    )
    options = CalibrationOptions(star_tracker_sigma_arcsec=SIGMA_ARCSEC)
    # Arrays have no magnitudes, by which the variances would be told apart.
    dark = each_image(
        ensemble(), lambda _, image: {'magnitude': np.full(len(image), np.nan, np.float32)}
    )
    expected = estimate_calibration(dark, SCENARIO.prior, options)
    assert found.accepted and found.stars_used == expected.kept.sum()
    # Directions are scaled to unit length once more, which moves their last bit.
    np.testing.assert_allclose(
        found.geometry.camera.parameters, expected.geometry.camera.parameters, rtol=1e-7
    )
    np.testing.assert_allclose(found.sigma**2, np.diag(expected.covariance), rtol=1e-6)
    assert found.provenance['catalog'] == ''


def test_stars_of_equal_directions_are_one_star() -> None:
    image = dict(arrays(ensemble().images[0]), catalog_id=None)
    later = dict(image, time_ns=image['time_ns'] + 1)
    first, second = (
        starcal_ground.observations_of(SCENARIO.prior.camera, **one) for one in (image, later)
    )
    assert np.array_equal(first.catalog_id, second.catalog_id)
    assert len(np.unique(first.catalog_id)) == len(first)


def test_one_covariance_serves_all_stars_and_records_are_not_changed_by_the_caller() -> None:
    image = ensemble().images[0]
    mine = image.measured_px.copy()
    one = {'measured_px': mine, 'covariance_px2': [[0.04, 0.01], [0.01, 0.09]]}
    stars = starcal_ground.observations_of(SCENARIO.prior.camera, **{**arrays(image), **one})
    mine += 1.0
    assert np.array_equal(stars.measured_px, image.measured_px)
    assert np.array_equal(stars.covariance_px2, np.tile([0.04, 0.01, 0.09], (len(stars), 1)))


@pytest.mark.parametrize(
    ('argument', 'value', 'complaint'),
    [
        ('measured_px', np.zeros(4), 'measured_px: 4 numbers, not n x 2'),
        ('measured_px', [[np.nan, 0.0]], r'measured_px\[0\]\[0\]: nan is not a finite number'),
        ('covariance_px2', np.zeros((3, 3)), r'covariance_px2: shape \(3, 3\) is not'),
        ('covariance_px2', -np.eye(2), 'covariance_px2: not symmetric and positive definite'),
        ('covariance_px2', [[1.0, 0.1], [0.0, 1.0]], 'covariance_px2: not symmetric'),
        ('direction_icrf', [[0.0, 0.0, 1.0]], r'direction_icrf: 1 x 3 numbers, not [0-9]+ x 3'),
        ('icrf_from_star_tracker_xyzw', [0.0, 0.0, 0.0, 2.0], 'xyzw: length 2 is not 1'),
        ('catalog_id', [1, 2], 'catalog_id: 2 numbers, not [0-9]+'),
    ],
)
def test_a_bad_array_is_named(argument, value, complaint) -> None:
    image = dict(arrays(ensemble().images[0]), **{argument: value})
    with pytest.raises(ValueError, match=complaint):
        starcal_ground.observations_of(SCENARIO.prior.camera, **image)


def test_options_are_checked_by_name_and_too_few_images_are_refused() -> None:
    for option, words in (
        ({'methd': 'single'}, 'did you mean method'),
        ({'method': 'best'}, 'method: .* is not one of'),
        ({'prior_alignment': (0, 0, 0, 1)}, 'prior_alignment: no such parameter'),
    ):
        with pytest.raises(starcal_ground.OptionError, match=words):
            starcal_ground.calibrate(ensemble().images, SCENARIO.prior, **option)
    with pytest.raises(starcal_ground.TooFewObservations, match='1 more image .* needed'):
        starcal_ground.calibrate(ensemble().images[:2], SCENARIO.prior)


@pytest.mark.slow
def test_a_bag_gives_what_the_tool_gives(tiny_bag, tiny_products) -> None:
    found = starcal_ground.calibrate_bag(tiny_bag, tiny_bag / 'params.yaml')
    written = starcal_ground.read_calibration(tiny_products)
    assert found.provenance == written.provenance
    assert np.array_equal(found.geometry.camera.parameters, written.geometry.camera.parameters)
    assert np.array_equal(found.covariance, written.covariance)
    again = starcal_ground.calibrate_bag(
        [tiny_products / 'observations.mcap'], str(tiny_bag / 'params.yaml')
    )
    assert again.stars_used == found.stars_used


@pytest.mark.parametrize(
    ('stated', 'words'),
    [
        ({'flip': 'upwards'}, "flip: 'upwards' is not one of left-right, top-bottom"),
        ({'times': {'other.png': 1}}, r'0\.png.*: not in the table of --times'),
    ],
)
def test_times_and_flip_of_image_files_are_those_of_the_tool(tmp_path, stated, words) -> None:
    folder = write_pngs(tmp_path / 'night', [np.zeros((8, 8), np.uint8)])
    with pytest.raises(starcal_ground.StarcalError, match=words):
        starcal_ground.calibrate_images(folder, **stated)
    with pytest.raises(starcal_ground.OptionError, match='flip: '):
        starcal_ground.calibrate_images('bags/tiny', **stated)


def test_a_calibration_is_written_and_read(tiny_products, tmp_path) -> None:
    calibration = starcal_ground.read_calibration(tiny_products)
    starcal_ground.write_calibration(calibration, tmp_path)
    starcal_ground.write_calibration(calibration, tmp_path / 'other.json')
    text = (tiny_products / 'calibration.json').read_text()
    assert (tmp_path / 'calibration.json').read_text() == text
    assert (tmp_path / 'other.json').read_text() == text


def test_lines_of_sight_are_of_either_frame() -> None:
    geometry = SCENARIO.truth
    pixels = np.array([[[0.0, 0.0], [100.0, 50.0]], [[319.5, 255.5], [639.0, 511.0]]])
    in_camera = starcal_ground.lines_of_sight(geometry, pixels)
    assert in_camera.shape == (2, 2, 3)
    # 1e-8 px: Newton's iteration stops at 4e-11 px, and arithmetic adds some more.
    np.testing.assert_allclose(
        starcal_ground.project(geometry.camera, in_camera), pixels, rtol=0, atol=1e-8
    )
    turn = geometry.star_tracker_from_camera
    expected = turn.apply(in_camera.reshape(-1, 3)).reshape(2, 2, 3)
    found = starcal_ground.lines_of_sight(geometry, pixels, frame='star_tracker')
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
    for back in (
        starcal_ground.project(geometry, 3.0 * in_camera, 'camera'),
        starcal_ground.project(geometry, 3.0 * found, 'star_tracker'),
    ):
        np.testing.assert_allclose(back, pixels, rtol=0, atol=1e-8)
    with pytest.raises(ValueError, match="frame: 'icrf' is not"):
        starcal_ground.lines_of_sight(geometry, pixels, frame='icrf')  # type: ignore[arg-type]


@pytest.mark.parametrize('frame', ['camera', 'star_tracker'])
def test_sigmas_of_lines_of_sight_are_those_of_the_table(tiny, frame) -> None:
    pixels = np.array([[[0.0, 0.0], [100.0, 50.0]], [[319.5, 255.5], [639.0, 511.0]]])
    table = lookup.line_of_sight_table(
        tiny.geometry.camera, tiny.map_covariance, pixels.reshape(-1, 2)
    )
    found = starcal_ground.line_of_sight_sigma_arcsec(tiny, pixels, frame)
    expected = table.shape_sigma_arcsec if frame == 'camera' else table.sigma_arcsec
    np.testing.assert_allclose(found, expected.reshape(2, 2), rtol=1e-9)  # rounding
    # No uncertainty is along the line of sight itself.
    covariance = starcal_ground.line_of_sight_covariance(tiny, pixels, frame)
    sights = starcal_ground.lines_of_sight(tiny, pixels, frame)
    along = np.einsum('...i,...ij,...j->...', sights, covariance, sights)
    assert (np.abs(along) < 1e-9 * np.trace(covariance, axis1=-2, axis2=-1)).all()


def test_the_camera_alone_has_no_frame_of_a_star_tracker(tiny) -> None:
    alone = dataclasses.replace(tiny, parent_frame='')
    for camera in (alone, alone.geometry.camera):
        assert starcal_ground.lines_of_sight(camera, [1.0, 2.0]).shape == (3,)
        with pytest.raises(ValueError, match='the camera alone has no alignment'):
            starcal_ground.lines_of_sight(camera, [1.0, 2.0], 'star_tracker')


def test_a_calibration_is_shown_in_three_lines_and_compared(tiny, tiny_products) -> None:
    one, same = tiny, starcal_ground.read_calibration(tiny_products)
    assert one == same and one != 'calibration'
    assert one != dataclasses.replace(one, covariance=2 * one.covariance)
    assert repr(one).count('\n') == 2 and len(repr(one)) < 300
    text = dataclasses.replace(one, accepted=False, reasons=('a < b',)).summary()
    assert 'refused by the gate' in text and 'refused: a < b' in text
    fx, sigma = one.geometry.camera.parameters[0], one.sigma[0]
    assert f'{fx:.3f}' in text and f'1-sigma {sigma:.2g}' in text
