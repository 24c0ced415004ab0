# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes with two star trackers, of which the first falls silent."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from scipy.spatial.transform import Rotation
import yaml

if TYPE_CHECKING:
    from conftest import Client, StartNode

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from mission_files import attitudes, images  # type: ignore[import-not-found]
from std_srvs.srv import Trigger

from starcal.msg import Calibration, EnsembleStatus
from starcal_ros.bag.writer import BagWriter
from starcal_ros.messages.calibration import calibration_from_message

pytestmark = pytest.mark.nodes

FIRST_FROM_OTHER = Rotation.from_euler('xyz', [100.0, -20.0, 35.0], degrees=True)


def test_one_takes_over_from_another(
    client: Client, start_node: StartNode, tiny_bag: Path, tmp_path: Path
) -> None:
    """Every image is used, and the calibration has the alignment to each star tracker."""
    parameters = yaml.safe_load((tiny_bag / 'params.yaml').read_text())
    values = parameters['/**']['ros__parameters']
    first_from_camera = Rotation.from_quat(values['prior_alignment'])
    values['more_star_trackers'] = ['other']
    alignment = (FIRST_FROM_OTHER.inv() * first_from_camera).as_quat()
    values['more_alignments'] = [float(x) for x in alignment]
    params = tmp_path / 'params.yaml'
    params.write_text(yaml.safe_dump(parameters))
    bag, samples = tmp_path / 'two', attitudes()
    with BagWriter(bag) as writer:
        for k, (time_ns, xyzw) in enumerate(samples):
            if k < 0.7 * len(samples):
                writer.write_attitude('/attitude', time_ns, xyzw, 'icrf')
            quaternion = (Rotation.from_quat(xyzw) * FIRST_FROM_OTHER).as_quat()
            writer.write_attitude('/other/attitude', time_ns, quaternion, 'icrf')
        for image in images():
            writer.write_image('/image', image, 'camera')
    for name in ('star_observer', 'calibrator'):
        start_node(name, ros=('--params-file', str(params)))
    client.until_listened()
    player = start_node('bag_player', ros=('-p', f'bag:={bag}', '-p', 'rate:=0.0'))
    assert player.wait(120.0) == 0, player.said()
    status = client.latched(EnsembleStatus, 'ensemble_status')
    client.until(lambda: status and status[-1].images == len(images()))
    answer = client.call(Trigger, '/calibrator/calibrate')
    assert answer.success, answer.message
    found = client.latched(Calibration, 'calibration')
    client.until(lambda: found)
    first, other = calibration_from_message(found[0]).star_trackers
    assert (first.frame, other.frame) == ('star_tracker', 'other')
    assert first.images + other.images == len(images()) and 0 < first.images < other.images
