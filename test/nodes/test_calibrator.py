# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrator in the process of the test: requests at once, new limits, foreign transforms."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import threading
from types import SimpleNamespace
from typing import Any

from geometry_msgs.msg import TransformStamped
import pytest
from rclpy.parameter import Parameter
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger
from vehicle import Client, in_this_process, tiny_observations  # type: ignore[import-not-found]

from starcal.msg import Calibration
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    camera_info_to_message,
)
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.node import make_message
from starcal_ros.ros.state import Answer

pytestmark = pytest.mark.nodes


@pytest.fixture
def calibrator(ros_domain: None, tiny_bag: Path) -> Iterator[Calibrator]:
    """An active calibrator in this process that holds the images of the small bag."""
    with in_this_process(Calibrator, tiny_bag) as node:
        for image in tiny_observations().images:
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


def test_diagnostics_are_of_the_limits_of_today(client: Client, calibrator: Calibrator) -> None:
    """Cleaned up, configured with a tighter limit, and back, in one process."""
    assert calibrator._on_calibrate(None, Trigger.Response()).success
    latched: list[Any] = client.latched(CameraInfo, 'camera_info')

    def configure(max_change_px: float) -> dict[str, object]:
        calibrator.trigger_deactivate()
        calibrator.trigger_cleanup()
        parameter = Parameter('max_change_px', Parameter.Type.DOUBLE, max_change_px)
        assert calibrator.set_parameters([parameter])[0].successful
        calibrator.trigger_configure()
        calibrator.trigger_activate()
        return dict(calibrator.health()[2])

    strict = configure(1e-6)
    assert strict['active'] == 'none' and str(strict['last_gate']).startswith('refused: calib')
    client.until(lambda: latched and latched[-1].k[0] == 0)
    assert not calibrator._on_calibrate(None, Trigger.Response()).success
    relaxed = configure(10.0)
    told = [relaxed[key] for key in ('active', 'last_gate', 'last_answer')]
    assert told == [1, 'accepted', '']
    client.until(lambda: latched[-1].k[0] > 0)


def transform(frame: str, x: float) -> TransformStamped:
    made = TransformStamped(child_frame_id=frame)
    made.transform.translation.x = x
    return made


def test_a_transform_of_another_node_is_named(
    calibrator: Calibrator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only to a frame that this node publishes too, and not its own message."""
    monkeypatch.setattr(calibrator, 'count_publishers', lambda topic: 2)
    own = transform(calibrator._setup.frames.camera_frame, 0.0)
    calibrator._own_transforms.append(own)
    calibrator._on_transforms(SimpleNamespace(transforms=[own, transform('other', 1.0)]))
    assert calibrator._foreign_transforms() == ''
    foreign = transform(f'/{own.child_frame_id}', 1.0)
    calibrator._on_transforms(SimpleNamespace(transforms=[foreign]))
    assert f'publishes {own.child_frame_id} too' in calibrator._foreign_transforms()
