# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Arguments of nodes for the small bag, and nodes in the process of a test."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
from pathlib import Path
from typing import Any

BOTH = ('star_observer', 'calibrator')
IMAGES, ATTITUDES = '/opnav/image_raw', '/star_tracker/attitude'
# The topics of the small bag.
REMAPS = (
    *('-r', f'image:={IMAGES}', '-r', f'attitude:={ATTITUDES}'),
    *('-r', 'velocity:=/spacecraft/velocity'),
)


def parameters(folder: Path, *values: str) -> tuple[str, ...]:
    """ROS arguments for the parameter file of a bag and further values."""
    more = [word for value in values for word in ('-p', value)]
    return ('--params-file', str(folder / 'params.yaml'), *more)


@contextlib.contextmanager
def in_this_process(kind: Any, folder: Path) -> Iterator[Any]:
    """An active node with the parameter file of a bag, in this process."""
    import rclpy

    with contextlib.ExitStack() as stack:
        rclpy.init(args=['--ros-args', *parameters(folder)])
        stack.callback(rclpy.try_shutdown)
        node = kind()
        stack.callback(node.destroy_node)
        node.trigger_configure()
        stack.callback(node.cleanup)
        node.trigger_activate()
        stack.callback(node.deactivate)
        yield node
