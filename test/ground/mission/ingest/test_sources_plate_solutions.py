# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes from the WCS that astropy fits to the sky of a known camera."""

from __future__ import annotations

import json
from pathlib import Path

from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs.utils import fit_wcs_from_points
from mission_files import date, images, TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.cli.main import main
from starcal_ground.images.from_stars import pinhole
from starcal_ground.images.photographs import ImageFile
from starcal_ground.mission.ingest.sources import read_wcs
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import IngestError
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.sensor_messages import attitude_from_message
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.formats.products.product_files import read_calibration

CAMERA = pinhole((1200, 900), 4000.0)
TURN = Rotation.from_euler('zyx', [40.0, -35.0, 100.0], degrees=True)  # icrf_from_camera


def header(turn: Rotation, camera: CameraModel, upside_down: bool) -> fits.Header:
    """The WCS of a camera; as FITS programs write it, the y axis points up."""
    xy = pixel_grid(camera, 12, 9)
    ra, dec = (lambda e: (np.arctan2(e[:, 1], e[:, 0]), np.arcsin(e[:, 2])))(
        turn.apply(line_of_sight(camera, xy))
    )
    if upside_down:
        xy = np.stack([xy[:, 0], camera.height - 1 - xy[:, 1]], axis=-1)
    wcs = fit_wcs_from_points(tuple(xy.T), SkyCoord(ra, dec, unit='rad'))
    return wcs.to_header()


def image_file(path: Path) -> ImageFile:
    """Facts of an image, of which only the start is written."""
    path.write_bytes(b'SIMPLE  =' if path.suffix == '.fits' else b'\x89PNG\r\n\x1a\n')
    return ImageFile(path, 10, 1200, 900, np.dtype('u1'), 0.0, 1.0, 1.0, np.nan, np.nan)


@pytest.mark.parametrize(('ending', 'upside_down'), [('.png', False), ('.fits', True)])
def test_the_wcs_of_a_camera_gives_its_attitude(
    tmp_path: Path, ending: str, upside_down: bool
) -> None:
    path = tmp_path / 'a.wcs'
    fits.PrimaryHDU(header=header(TURN, CAMERA, upside_down)).writeto(path)
    found = read_wcs([path], [image_file(tmp_path / f'a{ending}')])
    off = Rotation.from_quat(found.icrf_from_star_tracker_xyzw[0]).inv() * TURN
    # The least squares of astropy end within 0.05 px of 52 arcsec (2.5 arcsec) of the camera.
    assert off.magnitude() < 0.1 * 52.0 * ARCSECOND_RAD
    assert found.rows_upward == upside_down and found.by_stars


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'RADESYS': 'FK4', 'EQUINOX': 1950.0}, 'ICRS or J2000 only'),
        ({'CTYPE1': 'GLON-TAN', 'CTYPE2': 'GLAT-TAN'}, 'ICRS or J2000 only'),
        ({'CTYPE1': 'X', 'CTYPE2': 'Y'}, 'no celestial WCS'),
    ],
)
def test_another_frame_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / 'a.wcs'
    given = header(TURN, CAMERA, False)
    given.update(change)
    fits.PrimaryHDU(header=given).writeto(path)
    with pytest.raises(IngestError, match=message):
        read_wcs([path], [image_file(tmp_path / 'a.png')])


def test_an_image_that_was_not_solved_is_named(tmp_path: Path) -> None:
    with pytest.raises(
        IngestError, match=r'b.png: --attitude has no file of this name \(1 of 1 images\)'
    ):
        read_wcs([tmp_path / 'a.wcs'], [image_file(tmp_path / 'b.png')])


@pytest.mark.slow
@pytest.mark.usefixtures('forked_readers')
def test_solved_fits_images_are_imported_and_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raws = reader.read_raw([TINY], ['/star_tracker/attitude'])
    samples = dict(attitude_from_message(reader.decode(raw)) for raw in raws)
    stamps = np.array(sorted(samples))
    truth = json.loads((TINY / 'truth.json').read_text())
    aligned = Rotation.from_matrix(truth['A_true']).inv()
    camera = read_camera_info(str(TINY / 'camera.yaml'))
    for k, image in enumerate(images()):
        near = samples[int(stamps[np.abs(stamps - image.time_ns).argmin()])]
        solved = header(Rotation.from_quat(near) * aligned, camera, True)
        solved['DATE-AVG'] = date(image.time_ns)
        fits.PrimaryHDU(image.pixels[::-1], solved).writeto(tmp_path / f'{k}.fits')
    pattern, bag = str(tmp_path / '*.fits'), tmp_path / 'bag'
    prior = ['--camera', str(TINY / 'camera.yaml')]
    assert (
        main(['import', '--images', pattern, '--attitude', pattern, '-o', str(bag), *prior]) == 0
    )
    assert 'their order is reversed' in capsys.readouterr().out
    out = tmp_path / 'out'
    params = ['--params', str(bag / 'params.yaml'), '--no-report']
    assert main(['calibrate', str(bag), *params, '-o', str(out)]) == 0
    found = read_calibration(out / 'calibration.json')
    assert not found.has_alignment and found.images_used == len(images())
