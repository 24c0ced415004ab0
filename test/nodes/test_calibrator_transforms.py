# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Transforms of another node to the frames of a calibrator, on the node itself."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from geometry_msgs.msg import TransformStamped
from node_inputs import in_this_process  # type: ignore[import-not-found]

from starcal_ros.ros.calibrator import Calibrator

pytestmark = pytest.mark.nodes


def transform(frame: str, x: float) -> TransformStamped:
    made = TransformStamped(child_frame_id=frame)
    made.transform.translation.x = x
    return made


def test_a_transform_of_another_node_is_named(
    ros_domain: None, tiny_bag: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only to a frame that this node publishes too, and not its own message."""
    with in_this_process(Calibrator, tiny_bag, is_active=False) as node:
        monkeypatch.setattr(node, 'count_publishers', lambda topic: 2)
        own = transform(node._setup.frames.camera_frame, 0.0)
        node._own_transforms.append(own)
        node._on_transforms(SimpleNamespace(transforms=[own, transform('other', 1.0)]))
        assert node._foreign_transforms() == ''
        foreign = transform(f'/{own.child_frame_id}', 1.0)
        node._on_transforms(SimpleNamespace(transforms=[foreign]))
        assert f'publishes {own.child_frame_id} too' in node._foreign_transforms()
