# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files and messages from outside, spoilt by hypothesis: read, or refused in one line, in time."""

from collections.abc import Callable, Iterator
import contextlib
import json
import os
from pathlib import Path

from attacks import BAG, bag_setup, calibration, drawn, spoilt_text  # type: ignore[import-not-found]
from hypothesis import given
import numpy as np
import pytest

from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader
from starcal_ground.cli import main
from starcal_ground.comparison import compare
from starcal_ground.parameter_files import NODES, read_parameter_file
from starcal_ground.products import prior_of
from starcal_ground.written_files import write_calibration
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import field_radius_rad, line_of_sight, pixel_grid, project
from starcal_ros.errors import StarcalError
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import Image

pytestmark = pytest.mark.slow


@contextlib.contextmanager
def read_or_refused() -> Iterator[None]:
    """A `StarcalError` of one line may leave the block, no other exception."""
    refusal = ''
    with np.errstate(all='ignore'):
        try:
            yield
        except StarcalError as error:
            refusal = str(error)
    assert len(refusal.splitlines()) <= 1 and len(refusal) < 5000


def spoils(base: str, path: Path, read: Callable[[Path], None], count: int = 60) -> None:
    """Write spoilt copies of a text to a file, and read each."""

    @drawn(count)
    @given(spoilt_text(base))
    def spoil(content: bytes) -> None:
        path.write_bytes(content)
        with read_or_refused():
            read(path)

    spoil()


def test_parameter_files(tmp_path) -> None:
    flow = {n: list(v) if isinstance(v, tuple) else v for n, v in bag_setup().options().items()}
    lines = [f'    {name}: {json.dumps(value)}' for name, value in flow.items()]

    def read(path: Path) -> None:
        load_setup(read_parameter_file(path, NODES), bag_setup().prior)

    text = '\n'.join(['/**:', '  ros__parameters:', *lines])
    spoils(text, tmp_path / 'params.yaml', read)


def test_camera_files(tmp_path) -> None:
    def read(path: Path) -> None:
        camera = read_camera_info(path)
        project(camera, line_of_sight(camera, pixel_grid(camera, 5, 5)))
        field_radius_rad(camera)
        assert camera.ros_fit[1] >= 0.0

    spoils((BAG / 'camera.yaml').read_text(), tmp_path / 'camera.yaml', read)


def test_metadata_of_bags(tmp_path) -> None:
    """The bag beside it is read, not another one."""
    with BagWriter(tmp_path / 'bag') as writer:
        for k in range(3):
            writer.write_image('/image', Image(k, np.zeros((2, 2), np.uint8)), '')

    def read(path: Path) -> None:
        assert [topic.count for topic in reader.topics([path.parent])] == [3]

    path = tmp_path / 'bag' / 'metadata.yaml'
    spoils(path.read_text(), path, read)


def test_calibration_files(tmp_path) -> None:
    path = tmp_path / CALIBRATION_FILE
    write_calibration(calibration(), path)

    def read(path: Path) -> None:
        back = read_calibration(path)
        prior_of(back)
        if back.accepted or back.forced:
            compare(calibration(), back)
            camera = back.geometry.camera
            line_of_sight_table(camera, back.map_covariance, pixel_grid(camera, 3, 3))

    spoils(path.read_text(), path, read)


def test_pipes_in_a_folder_are_no_bag(tmp_path, capsys) -> None:
    for name in ('metadata.yaml', 'a.mcap'):
        os.mkfifo(tmp_path / name)
    assert main.main(['diagnose', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert 'no .mcap files in the folder' in error and error.count('\n') == 1
