# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Client of ``~/calibrate`` for `starcal demo`: the wheels of ROS have no ``ros2 service call``.

Prints the answer with exit status 0, or one line with status 2 where there is none.
"""

from __future__ import annotations

import sys

import rclpy
from std_srvs.srv import Trigger

from starcal_ros.errors import StarcalError
from starcal_ros.ros.node import end_quietly, until_told_to_end
from starcal_ros.text import printable

NAME = 'calibrate_client'
_DISCOVERY_S, _ANSWER_S = 10.0, 60.0


def _ask() -> int:
    node = rclpy.create_node(NAME)
    client = node.create_client(Trigger, 'calibrator/calibrate')
    if not client.wait_for_service(timeout_sec=_DISCOVERY_S):
        raise StarcalError(f'no service {client.srv_name}')
    answer = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, answer, timeout_sec=_ANSWER_S)
    if not answer.done():
        raise StarcalError(f'no answer of {client.srv_name} within {_ANSWER_S:g} s')
    print(printable(answer.result().message))
    return 0


def main() -> int:
    """Ask the calibrator of this ROS domain for a calibration."""
    return until_told_to_end(NAME, None, _ask, lambda: end_quietly(None))


if __name__ == '__main__':
    sys.exit(main())
