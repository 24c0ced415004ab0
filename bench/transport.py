# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Fast DDS with and without config/fastdds.xml: latency of a small and a large message.

One participant sends an attitude and just after it a frame of 10.6 MB, five times a second, to a
reader in another process.  Stock Fast DDS holds the small one back until its heartbeat.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
import contextlib
from functools import partial
import importlib.util
import multiprocessing
from pathlib import Path
import statistics
import time
from typing import Any

from bench import graph
from bench.table import Table
from bench.trials import environment

PROFILE = Path(__file__).parents[1] / 'config' / 'fastdds.xml'
FRAME_BYTES = 2592 * 2048 * 2
RATE_HZ = 5.0
_LATE_S = 8.0


def run(quick: bool) -> Iterator[Table]:
    """Run both settings, reliable and best effort, alternating."""
    if not importlib.util.find_spec('rclpy'):
        print('transport: no rclpy here: left out\n')
        return
    columns = (
        'profile, images, sent, images lost, median ms, worst ms, '
        'attitudes lost, attitude median ms, attitude worst ms'
    )
    title = 'An attitude and a frame of 10.6 MB just after it, by one participant, 5 a second'
    table = Table(title, columns.split(', '))
    graph.own_domain()
    count = 10 if quick else 60
    spawn = multiprocessing.get_context('spawn')
    for reliability in ('reliable', 'best_effort'):
        for name in ('stock', 'fastdds.xml'):
            with profile(name), ProcessPoolExecutor(2, mp_context=spawn) as pool:
                sent = pool.submit(_send, reliability, count)
                late = pool.submit(_take, reliability, count).result()
                sent.result(60.0)
            cells: list[float | None] = []
            for times_ms in late:
                cells += [count - len(times_ms)]
                cells += [statistics.median(times_ms), max(times_ms)] if times_ms else [None, None]
            table.add(name, reliability, count, *cells)
    yield table


def profile(name: str) -> contextlib.AbstractContextManager[None]:
    """Context manager: processes started within it use stock Fast DDS or the package's profile."""
    files = {f'{dds}_DEFAULT_PROFILES_FILE': str(PROFILE) for dds in ('FASTRTPS', 'FASTDDS')}
    values = {**files, 'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'} if name != 'stock' else {}
    return environment(**values)


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


def _take(reliability: str, count: int) -> tuple[list[float], list[float]]:
    """Latencies of the images and of the attitudes, ms."""
    from sensor_msgs.msg import Image, Temperature

    images_ms: list[float] = []
    attitudes_ms: list[float] = []

    def note(late_ms: list[float], message: Any) -> None:
        stamp = message.header.stamp
        late_ms.append(1e3 * (time.time() - stamp.sec - stamp.nanosec * 1e-9))

    with graph.Client('taker') as client:
        node, qos = client.node, _qos(reliability, 10)
        node.create_subscription(Image, 'image', partial(note, images_ms), qos)
        qos = _qos('reliable', 100)
        node.create_subscription(Temperature, 'attitude', partial(note, attitudes_ms), qos)
        most_s = 15.0 + _LATE_S + count / RATE_HZ
        client.holds(lambda: min(len(images_ms), len(attitudes_ms)) >= count, most_s)
    return images_ms, attitudes_ms
