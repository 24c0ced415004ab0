# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration that is not active any more: what is latched, and what its consumers do."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Any, TYPE_CHECKING

from geometry_msgs.msg import TransformStamped
from node_inputs import IMAGES, parameters, REMAPS  # type: ignore[import-not-found]
import pytest
from sensor_msgs.msg import CameraInfo, Image

from starcal.msg import Calibration
from starcal_ground.bags import reader
from starcal_ground.ros.monitor_client import Monitor
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.records import Activation
from starcal_ros.records import Ensemble as EnsembleRecord
from starcal_ros.ros.archive import Archive

if TYPE_CHECKING:
    from conftest import Client, StartNode

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
    name: str, client: Client, start_node: StartNode, tiny_bag: Path, tiny_products: Path,
    tmp_path: Path,
) -> None:  # fmt: skip
    """The star observer, the camera of each image, and the monitor; and back to a calibration."""
    values, folder, why = HEIRS[name]
    stored = read_calibration(tiny_products / CALIBRATION_FILE)
    stored = dataclasses.replace(stored, number=1, active_since_ns=1)
    with contextlib.closing(Archive(tmp_path / 'state', 'camera')) as archive:
        archive.keep(EnsembleRecord(), (Activation(1, 0, stored),))
    start_node('star_observer', ros=(*parameters(tiny_bag, 'attitude_timeout_s:=0.0'), *REMAPS))
    ros = parameters(tiny_bag, f'state_dir:={tmp_path}/state')
    first = start_node('calibrator', ros=ros)
    client.until_value('calibration', '1')
    infos: list[Any] = client.collect(CameraInfo, 'image_camera_info')
    images = client.publisher(Image, IMAGES)
    image = next(reader.read_raw([tiny_bag], [IMAGES])).data
    client.until(lambda: (images.publish(image), infos)[1])
    assert infos[-1].k[0] > 0

    monitor = Monitor(client._context)
    client._executor.add_node(monitor)
    client.until(lambda: monitor.received.active is not None)
    first.stop()
    place = f'state_dir:={tmp_path}/{folder}'
    heir = start_node(
        'calibrator', ros=(*parameters(tiny_bag, place, *values), '-r', '__node:=heir')
    )
    client.until_value('calibration', 'prior')
    client.until(lambda: 'images' in client.health('heir')[2])
    level, text, values = client.health('heir')
    withheld = str(int(bool(why)))
    assert (values['active'], values['state_refused_calibrations']) == ('none', withheld)
    if why:
        assert level == b'\x01' and text.startswith(f'{why} refuses it now: largest change')
        assert 'max_change_px' in text and text in heir.said()
        assert values['last_gate'] == f'refused: {text}'
    assert f'state_dir {tmp_path}/{folder}; no calibration active; 0 images' in heir.said()
    client.until(lambda: client.health()[0] == b'\x01')
    assert 'the prior predicts the stars' in client.health()[1] and why in client.health()[1]
    client.until(lambda: monitor.received.active is None)
    assert why in monitor.received.why_none
    client._executor.remove_node(monitor)
    monitor.destroy_node()
    client.until(lambda: (images.publish(image), infos[-1].k[0] == 0)[1])
    assert not infos[-1].k.any() and infos[-1].width == stored.geometry.camera.width
    assert infos[-1].header.frame_id != ''

    # A late subscriber is told so too.
    calibrations = client.latched(Calibration, 'calibration')
    cameras = client.latched(CameraInfo, 'camera_info')
    alignments = client.latched(TransformStamped, 'alignment')
    client.until(lambda: calibrations and cameras and alignments)
    (none,) = calibrations
    assert (none.number, none.accepted, none.camera.width) == (0, False, 0)
    assert [why in reason for reason in none.reasons] == [True] * bool(why)
    assert not cameras[0].k.any() and not cameras[0].d
    rotation = alignments[0].transform.rotation
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.0, 0.0, 0.0, 0.0)

    heir.stop()
    start_node('calibrator', ros=(*ros, '-r', '__node:=third'))
    client.until_value('calibration', '1')
    client.until(lambda: 'the prior predicts the stars' not in client.health()[1])
