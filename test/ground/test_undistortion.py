# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images without distortion: stars where a pinhole camera has them, in files of all kinds."""

import dataclasses
from typing import Any

from astropy.io import fits
import cv2
import numpy as np
import pytest

from starcal_ground.mirror import MIRRORED
from starcal_ground.simulation import rendering
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.undistortion import straight_camera, undistort_file, undistort_maps
from starcal_ground.written_files import write_calibration
from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight, pixel_grid, project
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.records import PIXELS_OF

_ELECTRONS = 1e5  # of a star: its brightest pixel has half of the range of the detector
_HALF_PX = 4


def centroid_px(values: Any, near_px: Floats) -> Floats:
    """Centroid about a pixel, weighted by a Gaussian about itself."""
    centre = near_px.copy()
    u0, v0 = np.rint(near_px).astype(int)
    window = np.s_[v0 - _HALF_PX : v0 + _HALF_PX + 1, u0 - _HALF_PX : u0 + _HALF_PX + 1]
    light = values[window].astype(float) - np.median(values[window])
    v, u = np.mgrid[window].astype(float)
    for _ in range(30):
        weight = light * np.exp(-0.5 * ((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / 1.3**2)
        apart = np.array([(weight * (u - centre[0])).sum(), (weight * (v - centre[1])).sum()])
        centre += 2.0 * apart / weight.sum()
    return centre


@pytest.mark.parametrize('k1', [-0.3, 0.3])
def test_stars_are_where_a_pinhole_camera_has_them(tiny, k1) -> None:
    given = synthetic.scenario('tiny')
    nominal = given.truth.camera
    camera = nominal.replace(k1=k1, skew=0.5, fy=1.01 * float(nominal.parameters[2]))
    given = dataclasses.replace(given, truth=dataclasses.replace(given.truth, camera=camera))
    stars_px = (
        np.random.default_rng(3).uniform(-0.5, 0.5, (30, 2))
        + pixel_grid(camera, 8, 7)[np.r_[9:15, 17:23, 25:31, 33:39, 41:47]]
    )
    shown = dataclasses.replace(
        synthetic.scene(given, 1), pixel_px=stars_px, flux_electrons=np.full(30, _ELECTRONS)
    )
    image = rendering.render(given, shown, 1)
    made = dataclasses.replace(tiny, geometry=given.truth)
    values = cv2.remap(image.pixels, *undistort_maps(made), cv2.INTER_LANCZOS4)
    expected_px = project(straight_camera(camera), line_of_sight(camera, stars_px))
    error_px = np.array([centroid_px(values, px) - px for px in expected_px])
    assert np.abs(expected_px - stars_px).max() > 2.0
    # OpenCV interpolates at a 32nd of a pixel, 0.016 px at most; photons move a star by 0.004 px.
    assert np.abs(error_px).max() < 0.03


def test_images_of_any_kind_are_straightened(tiny, tmp_path, starcal) -> None:
    write_calibration(tiny, tmp_path / 'calibration.json')
    height, width = tiny.geometry.camera.height, tiny.geometry.camera.width
    ramp = np.tile(np.arange(width, dtype=np.uint16), (height, 1))
    photos = tmp_path / 'photos'
    photos.mkdir()
    cv2.imwrite(str(photos / 'grey.png'), 90 * ramp)
    colours = np.dstack([ramp // 4, ramp // 8, 0 * ramp])
    cv2.imwrite(str(photos / 'colours.jpg'), colours.astype(np.uint8))
    fits.PrimaryHDU(ramp.astype(np.float32)).writeto(photos / 'ramp.fits')
    cv2.imwrite(str(photos / 'small.png'), ramp[:100])
    (photos / 'notes.txt').write_text('clouds')
    said = starcal('undistort', tmp_path, photos, '-o', tmp_path / 'straight').words
    assert '3 images and camera_info.yaml written' in said
    assert '1 file (small.png): 640 x 100 pixels, not 640 x 512' in said
    read = {
        name: np.asarray(cv2.imread(str(tmp_path / 'straight' / name), cv2.IMREAD_UNCHANGED))
        for name in ('grey.png', 'colours.jpg', 'ramp.tiff')
    }
    assert [values.dtype for values in read.values()] == [np.uint16, np.uint8, np.float32]
    assert read['colours.jpg'].shape == (height, width, 3)
    map_u, map_v = undistort_maps(tiny)
    inside = (map_u > 4) & (map_u < width - 5) & (map_v > 4) & (map_v < height - 5)
    # A ramp has the value of its pixel; OpenCV interpolates at a 32nd of one.
    assert np.abs(read['ramp.tiff'] - map_u)[inside].max() < 1.0 / 32.0
    straight = read_camera_info(tmp_path / 'straight' / 'camera_info.yaml')
    assert not straight.distortion.any()
    assert straight.parameters[:5].tolist() == pytest.approx(
        straight_camera(tiny.geometry.camera).parameters[:5].tolist()
    )


@pytest.mark.parametrize(
    ('flip', 'read'), [('top-bottom', np.s_[::-1]), ('left-right', np.s_[:, ::-1])]
)
def test_mirrored_files_are_mirrored_back_and_said_so(tiny, tmp_path, starcal, flip, read) -> None:
    """As `starcal calibrate` did, which found that their stars are mirrored."""
    plain = np.random.default_rng(1).integers(0, 255, (512, 640), np.uint8)
    cv2.imwrite(str(tmp_path / 'plain.png'), plain)
    cv2.imwrite(str(tmp_path / 'mirrored.png'), plain[read])
    provenance = {**tiny.provenance, PIXELS_OF: f'{MIRRORED[flip]}: as the stars show'}
    mirrored = dataclasses.replace(tiny, provenance=provenance)
    maps = undistort_maps(tiny)
    undistort_file(tmp_path / 'plain.png', tiny, maps, tmp_path / 'a.png')
    undistort_file(tmp_path / 'mirrored.png', mirrored, maps, tmp_path / 'b.png')
    assert (tmp_path / 'a.png').read_bytes() == (tmp_path / 'b.png').read_bytes()
    for calibration, words in ((tiny, False), (mirrored, True)):
        write_calibration(calibration, tmp_path / 'calibration.json')
        said = starcal('undistort', tmp_path, tmp_path / 'plain.png', '-o', tmp_path / 'o').words
        assert (f'{MIRRORED[flip]}, as the images of the calibration were' in said) is words
