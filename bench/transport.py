# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Fast DDS with and without config/fastdds.xml: latency of a small and a large message.

One participant sends an attitude and just after it a frame of 10.6 MB, five times a second, to a
reader in another process.  Stock Fast DDS holds the small one back until its heartbeat.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import importlib.util
import os
from pathlib import Path
import statistics
import subprocess
import sys
import time
from typing import Any

from bench import graph
from bench.table import Table

PROFILE = Path(__file__).parents[1] / 'config' / 'fastdds.xml'
FRAME_BYTES = 2592 * 2048 * 2
RATE_HZ = 5.0
_LATE_S = 8.0


def run(quick: bool) -> Iterator[Table]:
    """Run both settings, reliable and best effort, alternating."""
    if not importlib.util.find_spec('rclpy'):
        print('transport: no rclpy here: left out\n')
        return
    table = Table(
        'An attitude and a frame of 10.6 MB just after it, by one participant, 5 a second',
        (
            *('profile', 'images', 'sent', 'images lost', 'median ms', 'worst ms'),
            *('attitudes lost', 'attitude median ms', 'attitude worst ms'),
        ),
    )
    graph.own_domain()
    count = 10 if quick else 60
    for reliability in ('reliable', 'best_effort'):
        for profile in ('stock', 'fastdds.xml'):
            environment = {**os.environ, **settings(profile)}
            command = [sys.executable, '-m', 'bench.transport']
            sender = subprocess.Popen([*command, 'send', reliability, str(count)], env=environment)
            done = subprocess.run(
                [*command, 'take', reliability, str(count)],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
            )
            sender.wait(60)
            late = [[float(word) for word in line.split()] for line in done.stdout.splitlines()]
            cells: list[Any] = []
            for times_ms in late:
                cells += [count - len(times_ms)]
                cells += [statistics.median(times_ms), max(times_ms)] if times_ms else [None, None]
            table.add(profile, reliability, count, *cells)
    yield table


def settings(profile: str) -> dict[str, str]:
    """Environment of a process with stock Fast DDS, or with the profile of the package."""
    if profile == 'stock':
        return {}
    files = {f'{name}_DEFAULT_PROFILES_FILE': str(PROFILE) for name in ('FASTRTPS', 'FASTDDS')}
    return {**files, 'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'}


@contextlib.contextmanager
def profile(name: str) -> Iterator[None]:
    """Context manager: processes started within it use a profile."""
    values = settings(name)
    os.environ.update(values)
    try:
        yield
    finally:
        for value in values:
            del os.environ[value]


def _qos(reliability: str, depth: int) -> Any:
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=depth, reliability=ReliabilityPolicy[reliability.upper()])


def _send(reliability: str, count: int) -> None:
    from array import array

    from sensor_msgs.msg import Image, Temperature

    with graph.Client('sender') as client:
        images = client.node.create_publisher(Image, 'image', _qos(reliability, 10))
        small = client.node.create_publisher(Temperature, 'attitude', _qos('reliable', 100))
        client.until(
            lambda: images.get_subscription_count() and small.get_subscription_count(), ''
        )
        frame = Image(data=array('B', bytes(FRAME_BYTES)))
        time.sleep(2.0)  # discovery is not symmetric
        start_s = time.monotonic()
        for k in range(count):
            time.sleep(max(0.0, start_s + k / RATE_HZ - time.monotonic()))
            for message, publisher in ((Temperature(), small), (frame, images)):
                seconds = time.time()  # one machine: both processes read the same clock
                message.header.stamp.sec = int(seconds)
                message.header.stamp.nanosec = int(seconds % 1 * 1e9)
                publisher.publish(message)
        time.sleep(_LATE_S)


def _take(reliability: str, count: int) -> None:
    from sensor_msgs.msg import Image, Temperature

    late_ms: dict[str, list[float]] = {'image': [], 'attitude': []}

    def take(kind: str, message: Any) -> None:
        stamp = message.header.stamp
        late_ms[kind].append(1e3 * (time.time() - stamp.sec - stamp.nanosec * 1e-9))

    with graph.Client('taker') as client:
        for kind, cls, qos in (
            ('image', Image, _qos(reliability, 10)),
            ('attitude', Temperature, _qos('reliable', 100)),
        ):
            client.node.create_subscription(
                cls,
                kind,
                lambda message, kind=kind: take(kind, message),  # type: ignore[misc]
                qos,
            )
        client.holds(
            lambda: min(map(len, late_ms.values())) >= count, 15.0 + _LATE_S + count / RATE_HZ
        )
    for times_ms in late_ms.values():
        print(*times_ms)


if __name__ == '__main__':
    {'send': _send, 'take': _take}[sys.argv[1]](sys.argv[2], int(sys.argv[3]))
