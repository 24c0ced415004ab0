# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A separate ROS graph for a bench: node processes, a client, and their resource usage."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
import time
from typing import Any

from bench.frames import Frame
from bench.trials import environment
from starcal_ground.bag_writer import attitude_to_message, image_to_message
from starcal_ground.cli.node_processes import free_domain
from starcal_ros.ros.node import make_message

PROFILE = Path(__file__).parents[1] / 'config' / 'fastdds.xml'
_HELD = contextlib.ExitStack()
START_S = 240.0  # a node starts in 2 s; much slower on a busy machine


def own_domain() -> None:
    """Move this process and its children to an unused ROS domain, held until the process ends."""
    os.environ.update(_HELD.enter_context(free_domain()))


def profile(name: str) -> contextlib.AbstractContextManager[None]:
    """Context manager: processes started within it use stock Fast DDS or the package's profile."""
    files = {f'{dds}_DEFAULT_PROFILES_FILE': str(PROFILE) for dds in ('FASTRTPS', 'FASTDDS')}
    values = {**files, 'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'} if name != 'stock' else {}
    return environment(**values)


def start(name: str, params: Path, log: Path, *values: str) -> subprocess.Popen[bytes]:
    """Start a node process with parameters."""
    arguments = ['-m', 'starcal_ros.entry_points', name]
    arguments += ['--ros-args', '--params-file', str(params)]
    arguments += [word for value in values for word in ('-p', value)]
    arguments += ['--log-level', 'warn']
    with log.open('ab') as output:
        return subprocess.Popen(
            [sys.executable, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )


@contextlib.contextmanager
def running(name: str, params: Path, log: Path, *values: str) -> Iterator[subprocess.Popen[bytes]]:
    """Context manager of a node process; stops it at the end."""
    process = start(name, params, log, *values)
    try:
        yield process
    finally:
        stop(process)


def stop(process: subprocess.Popen[bytes]) -> int:
    """Exit status after SIGINT; kills the process if it does not end."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(START_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


class Client:
    """A node with its own context that is spun while waiting."""

    def __init__(self, name: str = 'bench') -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node(name, context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()

    def spin(self, seconds: float = 0.0) -> None:
        """Process at most one event within a timeout."""
        self._executor.spin_once(timeout_sec=seconds)

    def until(
        self, condition: Callable[[], object], what: str, timeout_s: float = START_S
    ) -> None:
        """Spin until a condition holds; RuntimeError after the timeout."""
        if not self.holds(condition, timeout_s):
            raise RuntimeError(f'{what}: not within {timeout_s:g} s')

    def holds(self, condition: Callable[[], object], timeout_s: float = START_S) -> bool:
        """Spin until a condition holds; False after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            self.spin(0.02)
        return True

    def collect(self, kind: Any, topic: str, take: Callable[[Any], None], latched: bool) -> Any:
        """Subscribe to a topic."""
        qos = _qos(1 if latched else 5000, latched)
        return self.node.create_subscription(kind, topic, take, qos)

    def publisher(self, kind: Any, topic: str, depth: int = 1000) -> Any:
        """Publisher with at least one matched subscriber."""
        publisher = self.node.create_publisher(kind, topic, _qos(depth))
        self.until(publisher.get_subscription_count, f'a listener of {topic}')
        return publisher


def _qos(depth: int, latched: bool = False) -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile

    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=depth, durability=durability)


class Sender:
    """
    Sends frames in turn, each as a serialised message and with its own attitude.

    Camera and star tracker are participants of their own, as on a spacecraft: Fast DDS delays a
    small message by up to its heartbeat, 3 s, when its participant sends a large one just after.
    """

    def __init__(self, camera: Client, tracker: Client, frames: Sequence[Frame]) -> None:
        from geometry_msgs.msg import QuaternionStamped
        from rclpy.serialization import serialize_message
        from sensor_msgs.msg import Image

        self._ready = [
            (
                serialize_message(image_to_message(image, 'camera', make_message)),
                image.pixels.nbytes,
                samples[1].icrf_from_star_tracker_xyzw,
            )
            for image, samples in frames
        ]
        self._images = camera.publisher(Image, 'image', 20)
        self._attitudes = tracker.publisher(QuaternionStamped, 'attitude')

    def send(self, k: int, time_ns: int, around_ns: Sequence[int]) -> None:
        """Publish frame ``k`` with another stamp and first pixels, and attitudes about it."""
        content, size, xyzw = self._ready[k % len(self._ready)]
        for offset_ns in around_ns:
            message = attitude_to_message(time_ns + offset_ns, xyzw, 'icrf', make_message)
            self._attitudes.publish(message)
        # Images of equal pixels count once.  The pixels, of 16 bit, are the last of the message.
        first = len(content) - size
        other = struct.pack('<HH', 100 + k % 1000, 100 + k // 1000 % 1000)
        content = b''.join((content[:first], other, memoryview(content)[first + 4 :]))
        self._images.publish(stamped(content, time_ns))


def stamped(content: bytes, time_ns: int) -> bytes:
    """Return a serialised message whose header has another stamp."""
    # The stamp is first in the message, after four bytes of encoding.
    stamp = struct.pack('=iI', *divmod(time_ns, 10**9))
    return b''.join((content[:4], stamp, memoryview(content)[12:]))


def processor_s(number: int) -> float:
    """User and system time of a process so far."""
    fields = Path(f'/proc/{number}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')
