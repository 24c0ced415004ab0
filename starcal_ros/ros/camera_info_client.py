# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Client of the camera driver's set_camera_info service: sends each activated calibration."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from sensor_msgs.srv import SetCameraInfo

from starcal_ros.ros.node import StarcalNode

_TIMEOUT_S = 5.0  # of the service, and of its answer: a driver may write to flash memory
_LOOK_S = 0.5  # period of checks for the service and the timeout
_LONGEST_PAUSE_S = 300.0  # between two attempts at a driver that does not answer
ACCEPTED = 'accepted'


class CameraDriver:
    """
    Client of set_camera_info that reports the outcome of each call.

    A calibration is sent as soon as the service is available, and again to each server of it that
    appears: a driver that restarts has lost its camera.  Without an answer it is sent again after
    a pause that doubles, since the request or its answer may have been lost before the two had
    discovered each other.  After a refusal it is sent again only by `hand_over_again` or to a new
    server.  Safe to use from several threads.

    Parameters
    ----------
    node : StarcalNode
        Failures are logged through it.
    service : str
    """

    def __init__(self, node: StarcalNode, service: str) -> None:
        self.failures = 0
        self.outcome = 'no calibration'
        self.has_failed = False  # last attempt
        self._node, self._service = node, service
        self._camera_info: Any = None
        self._is_due = False  # to be sent once the service is available
        self._is_there = False
        self._servers: frozenset[bytes] = frozenset()
        self._call: Any = None
        self._since_s = 0.0
        self._pause_s = _TIMEOUT_S  # before it is sent again without an answer
        self._again_s = math.inf  # time of that, of the monotonic clock
        self._closed = False
        self._changed = threading.Condition(threading.RLock())
        group = ReentrantCallbackGroup()
        self._client = node.create_client(SetCameraInfo, service, callback_group=group)
        self._answers = f'rr{node.resolve_service_name(service)}Reply'  # its DDS topic
        self._timer = node.steady_timer(_LOOK_S, node.guarded(self._look), group)

    def close(self) -> None:
        """Destroy the client; pending calls return."""
        with self._changed:
            self._closed = True
            self._drop_call()
            self._changed.notify_all()
        self._node.destroy_timer(self._timer)
        self._node.destroy_client(self._client)

    def hand_over(self, camera_info: Any) -> None:
        """Send a sensor_msgs/CameraInfo in place of any earlier one; does not wait."""
        with self._changed:
            self._camera_info = camera_info
            self._begin()

    def hand_over_again(self) -> tuple[bool, str]:
        """Send the last one again and wait; return True if accepted, and a message."""
        with self._changed:
            if self._camera_info is None:
                return False, 'no calibration is active'
            self._begin()
            self._changed.wait_for(
                lambda: self._closed or not (self._is_due or self._call), 3 * _TIMEOUT_S
            )
            return self.outcome == ACCEPTED, f'{self._service}: {self.outcome}'

    def _begin(self) -> None:
        self._drop_call()
        self._is_due, self._since_s = True, time.monotonic()
        self._pause_s, self._again_s = _TIMEOUT_S, math.inf
        self.outcome, self.has_failed = 'waiting for the service', False
        self._look()

    def _look(self) -> None:
        with self._changed:
            if self._closed:
                return
            now_s = time.monotonic()
            overdue = now_s - self._since_s > _TIMEOUT_S
            appeared = self._has_appeared() and self._camera_info is not None
            if appeared:
                self._pause_s = _TIMEOUT_S
            if self._is_there and (self._is_due or appeared or now_s > self._again_s):
                self._send()
            elif self._is_due and overdue:
                self._end('service not available; will be sent when it is', False)
            elif self._call is not None and overdue:
                self._drop_call()
                self._end(f'no answer within {_TIMEOUT_S:g} s', False)
                self._again_s = now_s + self._pause_s
                self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)

    def _has_appeared(self) -> bool:
        """
        Return True if the service, or another server of it, has appeared since the last look.

        A driver restarts in less time than passes between two looks, and one that was killed
        counts as there until its lease ends, 20 s with Fast DDS.  Servers are known by the DDS
        topic of their answers; a middleware without DDS names leaves that empty.
        """
        was_there, self._is_there = self._is_there, self._client.service_is_ready()
        had = self._servers
        servers = self._node.get_publishers_info_by_topic(self._answers, no_mangle=True)
        self._servers = frozenset(bytes(server.endpoint_gid) for server in servers)
        return self._is_there and (not was_there or not self._servers <= had)

    def _send(self) -> None:
        self._drop_call()
        self._is_due, self._since_s, self._again_s = False, time.monotonic(), math.inf
        self.outcome = 'waiting for its answer'
        self._call = self._client.call_async(SetCameraInfo.Request(camera_info=self._camera_info))
        self._call.add_done_callback(self._node.guarded(self._answered))

    def _answered(self, call: Any) -> None:
        with self._changed:
            if call is not self._call or self._closed:
                return  # of a calibration that is no longer active
            self._call = None
            if call.exception() is not None:
                self._end(f'failed: {call.exception()}', False)
            elif call.result().success:
                self._end(ACCEPTED, True)
            else:
                self._end(f'refused: {" ".join(call.result().status_message.split())}', False)

    def _drop_call(self) -> None:
        if self._call is not None:
            self._client.remove_pending_request(self._call)
            self._call = None

    def _end(self, outcome: str, success: bool) -> None:
        self._is_due = False
        self.outcome, self.has_failed = outcome, not success
        said = f'{self._service}: {outcome}'
        if success:
            self._node.get_logger().info(said)
        else:
            self.failures += 1
            self._node.get_logger().error(said)
        self._changed.notify_all()
