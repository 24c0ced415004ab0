# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The log of a node, which quotes texts from messages and bags."""

from __future__ import annotations

import pytest
from vehicle import Client  # type: ignore[import-not-found]

from starcal_ground.ros.bag_player import BagPlayer
from starcal_ros.ros.node import StarcalNode
from starcal_ros.ros.printable_log import PrintableLog, PrintableLogger

pytestmark = pytest.mark.nodes


def test_a_line_that_logs_without_end_fills_no_disk(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten images a second are refused for ten minutes; another line logs as ever."""
    now_s = 0.0
    monkeypatch.setattr('starcal_ros.ros.printable_log.time.monotonic', lambda: now_s)
    logger = PrintableLogger('refusing')
    for k in range(6000):
        now_s = 0.1 * k
        logger.warning(f'image {k} refused')
    logger.warning('stamps went back')
    said = [line.partition(']: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert said[:100] == [f'image {k} refused' for k in range(100)]
    # One a minute is one of six hundred; the quotient may round to one image more.
    later = [int(line.rpartition('(and ')[2].partition(' left out)')[0]) for line in said[101:-1]]
    assert len(later) in (8, 9) and set(later) <= {599, 600}
    assert said[-1] == 'stamps went back'


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
