# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration that is not active any more: what is latched, and what its consumers do."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

from geometry_msgs.msg import TransformStamped
import pytest
from sensor_msgs.msg import CameraInfo, Image
from vehicle import IMAGES, REMAPS, Vehicle  # type: ignore[import-not-found]

from starcal.msg import Calibration
from starcal_ground.bags import reader
from starcal_ground.ros.monitor_client import Monitor
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.records import Activation
from starcal_ros.records import Ensemble as EnsembleRecord
from starcal_ros.ros.archive import Archive

pytestmark = pytest.mark.nodes

# How the heir of a calibrator differs, and why it has no active calibration.
HEIRS = {
    'stricter limits': (
        ('max_change_px:=1e-6',),
        'state',
        'calibration 1 is not active, the gate',
    ),
    'an empty folder': ((), 'empty', ''),
}


@pytest.mark.parametrize('name', HEIRS)
def test_consumers_return_to_the_prior(
    vehicle: Vehicle, name: str, tiny_products: Path, tmp_path: Path
) -> None:
    """The star observer, the camera of each image, and the monitor; and back to a calibration."""
    values, folder, why = HEIRS[name]
    stored = read_calibration(tiny_products / CALIBRATION_FILE)
    stored = dataclasses.replace(stored, number=1, active_since_ns=1)
    with contextlib.closing(Archive(tmp_path / 'state', 'camera')) as archive:
        archive.keep(EnsembleRecord(), (Activation(1, 0, stored),))
    vehicle.start('star_observer', 'attitude_timeout_s:=0.0', ros=REMAPS)
    kept = f'state_dir:={tmp_path}/state'
    first = vehicle.start('calibrator', kept)
    vehicle.until_value('calibration', '1')
    infos: list[Any] = vehicle.collect(CameraInfo, 'image_camera_info')
    images = vehicle.publisher(Image, IMAGES)
    image = next(reader.read_raw([vehicle.bag], [IMAGES])).data
    vehicle.until(lambda: (images.publish(image), infos)[1])
    assert infos[-1].k[0] > 0

    monitor = Monitor(vehicle._context)
    vehicle._executor.add_node(monitor)
    vehicle.until(lambda: monitor.received.active is not None)
    first.stop()
    place = f'state_dir:={tmp_path}/{folder}'
    heir = vehicle.start('calibrator', place, *values, ros=('-r', '__node:=heir'))
    vehicle.until_value('calibration', 'prior')
    vehicle.until(lambda: 'images' in vehicle.health('heir')[2])
    level, text, values = vehicle.health('heir')
    withheld = str(int(bool(why)))
    assert (values['active'], values['state_refused_calibrations']) == ('none', withheld)
    if why:
        assert level == b'\x01' and text.startswith(f'{why} refuses it now: largest change')
        assert 'max_change_px' in text and text in heir.said()
        assert values['last_gate'] == f'refused: {text}'
    assert f'state_dir {tmp_path}/{folder}; no calibration active; 0 images' in heir.said()
    vehicle.until(lambda: vehicle.health()[0] == b'\x01')
    assert 'the prior predicts the stars' in vehicle.health()[1] and why in vehicle.health()[1]
    vehicle.until(lambda: monitor.received.active is None)
    assert why in monitor.received.why_none
    vehicle._executor.remove_node(monitor)
    monitor.destroy_node()
    vehicle.until(lambda: (images.publish(image), infos[-1].k[0] == 0)[1])
    assert not infos[-1].k.any() and infos[-1].width == stored.geometry.camera.width
    assert infos[-1].header.frame_id != ''

    # A late subscriber is told so too.
    calibrations = vehicle.latched(Calibration, 'calibration')
    cameras = vehicle.latched(CameraInfo, 'camera_info')
    alignments = vehicle.latched(TransformStamped, 'alignment')
    vehicle.until(lambda: calibrations and cameras and alignments)
    (none,) = calibrations
    assert (none.number, none.accepted, none.camera.width) == (0, False, 0)
    assert [why in reason for reason in none.reasons] == [True] * bool(why)
    assert not cameras[0].k.any() and not cameras[0].d
    rotation = alignments[0].transform.rotation
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.0, 0.0, 0.0, 0.0)

    heir.stop()
    vehicle.start('calibrator', kept, ros=('-r', '__node:=third'))
    vehicle.until_value('calibration', '1')
    vehicle.until(lambda: 'the prior predicts the stars' not in vehicle.health()[1])
