# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Activations by several requests at once, on the node itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import threading
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from conftest import Client

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from geometry_msgs.msg import TransformStamped
from node_inputs import in_this_process  # type: ignore[import-not-found]
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from starcal.msg import Calibration
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    camera_info_to_message,
)
from starcal_ros.records import Ensemble
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.node import make_message
from starcal_ros.ros.state import Answer

pytestmark = pytest.mark.nodes


@pytest.fixture
def calibrator(
    ros_domain: None, tiny_bag: Path, tiny_observations: Ensemble
) -> Iterator[Calibrator]:
    """An active calibrator in this process that holds the images of the small bag."""
    with in_this_process(Calibrator, tiny_bag) as node:
        for image in tiny_observations.images:
            node._state.add(image)
        yield node


def test_what_is_latched_is_what_is_active(client: Client, calibrator: Calibrator) -> None:
    """The thread of the earlier of two activations may be the last to publish."""
    state = calibrator._state
    assert state.solve().success
    earlier, later = state.solve(estimate=('fx', 'fy'), force=True), state.rollback()
    assert earlier.active and later.active

    def tell(answer: Answer) -> None:
        for _ in range(20):
            calibrator._publish_and_answer(answer, Trigger.Response())

    threads = [threading.Thread(target=tell, args=(answer,)) for answer in (earlier, later)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    calibrator._publish_and_answer(earlier, Trigger.Response())
    infos = client.latched(CameraInfo, 'camera_info')
    alignments = client.latched(TransformStamped, 'alignment')
    calibrations = client.latched(Calibration, 'calibration')
    client.until(lambda: infos and alignments and calibrations)
    active = state.active
    assert active is not None and active is later.calibration
    found = calibration_from_message(calibrations[0])
    assert (found.number, found.active_since_ns) == (active.number, active.active_since_ns)
    assert infos == [camera_info_to_message(active, make_message)]
    assert alignments == [alignment_to_message(active, make_message)]
