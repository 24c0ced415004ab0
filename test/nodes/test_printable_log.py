# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The log of a node, which quotes texts from messages and bags."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from conftest import Client

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from starcal_ros.ros.bag_player import BagPlayer
from starcal_ros.ros.node import StarcalNode
from starcal_ros.ros.printable_log import PrintableLog

pytestmark = pytest.mark.nodes


def test_escape_sequences_do_not_reach_the_terminal(
    client: Client, capfd: pytest.CaptureFixture[str]
) -> None:
    """At each severity, from lines of their own."""
    assert issubclass(StarcalNode, PrintableLog) and issubclass(BagPlayer, PrintableLog)
    node = PrintableLog('quoting', context=client._context)
    try:
        node.get_logger().info('topic \x1b[2J')
        node.get_logger().warning('topic \x1b]0;title\x07')
        node.get_logger().error('line\ncalibrator: ok')
    finally:
        node.destroy_node()
    said = ''.join(capfd.readouterr())
    assert '\x1b' not in said and '\x07' not in said
    for text in ('topic \\x1b[2J', 'topic \\x1b]0;title\\x07', 'line\\ncalibrator: ok'):
        assert f'[quoting]: {text}\n' in said
