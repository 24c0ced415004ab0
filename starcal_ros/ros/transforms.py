# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Transforms that another node publishes as well as this one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import threading
from typing import Any


class Transforms:
    """
    The static transforms of a node and of others to the same frames, safe to use from threads.

    A frame has one parent: of two transforms to it each listener takes the one that came last.

    Parameters
    ----------
    frames : iterable of str
        Child frames of the node.
    """

    def __init__(self, frames: Iterable[str]) -> None:
        self._frames = {_name(frame) for frame in frames}
        self._own: list[Any] = []
        self._foreign: set[str] = set()
        self._lock = threading.Lock()

    def own(self, transforms: Sequence[Any]) -> None:
        """Add geometry_msgs/TransformStamped that this node is about to publish."""
        with self._lock:
            self._own += transforms
            self._frames |= {_name(transform.child_frame_id) for transform in transforms}

    def hear(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage of any node, this one included."""
        with self._lock:
            for transform in message.transforms:
                name = _name(transform.child_frame_id)
                if name in self._frames and transform not in self._own:
                    self._foreign.add(name)

    def foreign(self) -> list[str]:
        """Return the frames that another node has published a transform to, if this one has."""
        with self._lock:
            return sorted(self._foreign) if self._own else []


def _name(frame: str) -> str:
    return frame.lstrip('/')
