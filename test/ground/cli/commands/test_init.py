# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal init` on the simulated bag in the repository, whose truth stands beside it."""

from __future__ import annotations

import json
from pathlib import Path
import re

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.bag_writer import BagWriter
from starcal_ground.cli.main import main
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.sensor_messages import attitude_from_message
from starcal_ros.pipeline.setup import read_setup
from starcal_ros.records import Image

TINY = Path(__file__).parents[4] / 'bags' / 'tiny'
TRUTH = json.loads((TINY / 'truth.json').read_text())
IMAGES = '/opnav/image_raw'
ATTITUDES = '/star_tracker/attitude'
ALIGNMENT_DEG = 0.1  # noise of the star tracker in the bag: 0.011; a prior must be within 1.5


def tiny_images() -> list[Image]:
    return [one for one in reader.read_images([TINY], IMAGES) if isinstance(one, Image)]


def with_inverse_attitudes(path: Path) -> Path:
    """The bag with attitudes that take ICRF coordinates to the star tracker."""
    with BagWriter(path) as writer:
        for raw in reader.read_raw([TINY], [ATTITUDES]):
            time_ns, xyzw = attitude_from_message(reader.decode(raw))
            writer.write_attitude(ATTITUDES, time_ns, xyzw * [-1, -1, -1, 1], 'star_tracker')
        for image in tiny_images():
            writer.write_image(IMAGES, image, 'camera')
    return path


@pytest.mark.slow
@pytest.mark.parametrize('direction', ['st_to_inertial', 'inertial_to_st'])
def test_a_bag_gives_camera_direction_and_alignment(
    tmp_path: Path, direction: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = TINY if direction == 'st_to_inertial' else with_inverse_attitudes(tmp_path / 'b.mcap')
    first = tmp_path / 'first'
    assert main(['init', str(bag), '-o', str(first)]) == 0
    said = capsys.readouterr().out
    assert f'{ATTITUDES}: {direction}' in said
    assert 'left to state: star_tracker_sigma_arcsec: ' in said
    # What lowers a sigma most, by how much: from the first images.
    (worth,) = re.findall(
        'left to state: star_tracker_slow_arcsec: pointing (.*)″ becomes (.*)″ ', said
    )
    assert float(worth[1]) < float(worth[0])
    assert f'next: starcal calibrate {bag} --params {first / "params.yaml"}' in said
    setup = read_setup(first / 'params.yaml')
    assert setup.attitude.attitude_direction == direction
    aligned = Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)
    off = aligned * Rotation.from_matrix(TRUTH['A_true'])
    assert np.degrees(off.magnitude()) < ALIGNMENT_DEG
    # Five sigma of a fit to the brightest stars with 0.3 px each: 1801 px to 0.1 %.
    assert setup.prior.camera.parameters[0] == pytest.approx(TRUTH['k_true'][0], rel=1e-3)


@pytest.mark.slow
def test_photographs_give_the_camera_and_the_next_command_takes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    night, first = tmp_path / 'night', tmp_path / 'first'
    night.mkdir()
    for k, image in enumerate(tiny_images()[:5]):
        cv2.imwrite(str(night / f'{k}.png'), image.pixels)
    assert main(['init', str(night), '-o', str(first)]) == 0
    assert 'left to state: observer: ground' in capsys.readouterr().out
    params = ['--params', str(first / 'params.yaml'), '--no-report']
    assert main(['calibrate', str(night), *params, '-o', str(tmp_path / 'out')]) in (0, 3)
    with (first / 'params.yaml').open('a') as file:
        file.write('    shutter: global\n')
    assert main(['init', str(night), '-o', str(first)]) == 2
    assert 'params.yaml: was not written by starcal, or was changed' in capsys.readouterr().err
