# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Nodes that tests start, as processes or in their own, and a client of them."""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import functools
import inspect
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from forked_process import ForkedNode, ForkedProcess  # type: ignore[import-not-found]
import pytest

START_S = 240.0  # a node starts in 2 s; much slower on two busy cores
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


class LoggedProcess:
    def __init__(
        self, name: str, log: Path, process: ForkedProcess | subprocess.Popen[bytes]
    ) -> None:
        self.name, self._log, self.process = name, log, process

    def said(self) -> str:
        return self._log.read_text(errors='replace')

    def until_said(self, text: str) -> None:
        """Wait for a text in the output of a process that runs."""
        deadline_s = time.monotonic() + START_S
        while text not in self.said():
            assert self.process.poll() is None and time.monotonic() < deadline_s, self.said()
            time.sleep(0.05)

    def wait(self, timeout_s: float = START_S) -> int:
        """Wait for the end of the process; return its exit status.  One that hangs is killed."""
        try:
            return self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            # Python's fault handler answers SIGABRT with the stacks of all threads.
            self.process.send_signal(signal.SIGABRT)
            self.process.wait()
            pytest.fail(f'{self.name} did not end in {timeout_s:.0f} s:\n{self.said()}')

    def interrupt_group(self) -> int:
        """Exit status after SIGINT to the process group that it leads, as a terminal sends it."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.wait()

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit status, as `wait` does."""
        self.send(number)
        return self.wait()

    def send(self, number: int = signal.SIGINT) -> None:
        """Send a signal if the process still runs."""
        if self.process.poll() is None:
            self.process.send_signal(number)

    def end(self) -> None:
        """Wait for the end of the process; kill it if it does not end."""
        try:
            self.process.wait(START_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def with_log(command: Sequence[str], log: Path, **options: Any) -> subprocess.Popen[bytes]:
    with log.open('wb') as output:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            **options,
        )


class NodeProcess(LoggedProcess):
    def __init__(self, name: str, log: Path, arguments: list[str], forked: bool) -> None:
        log.touch()
        process: ForkedProcess | subprocess.Popen[bytes]
        if forked:
            process = ForkedNode(name, arguments, log)
        else:
            command = [sys.executable, '-m', 'starcal_ros.entry_points', name, *arguments]
            process = with_log(command, log, env={**os.environ, 'PYTHONFAULTHANDLER': '1'})
        super().__init__(name, log, process)


StartNode = Callable[..., NodeProcess]


def _seen(condition: Callable[..., object]) -> str:
    """Values that a condition refers to, shortened; of lists the last element."""
    function = condition.func if isinstance(condition, functools.partial) else condition
    arguments = condition.args if isinstance(condition, functools.partial) else ()
    looked_at = inspect.signature(function).bind(*arguments).arguments
    if inspect.isfunction(function):
        looked_at |= inspect.getclosurevars(function).nonlocals
    for asked in [value for value in looked_at.values() if inspect.isfunction(value)]:
        looked_at |= inspect.getclosurevars(asked).nonlocals
    newest = {
        name: (len(value), value[-1:]) if isinstance(value, list) else value
        for name, value in looked_at.items()
    }
    return ', '.join(f'{name} = {str(value)[:600]}' for name, value in newest.items())


def latched_qos() -> Any:
    from rclpy.qos import DurabilityPolicy, QoSProfile

    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Client:
    """A rclpy node that waits for conditions instead of sleeping."""

    def __init__(self, name: str = 'client') -> None:
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._diagnostics: list[Any] | None = None
        self._statuses: list[Any] | None = None
        self._services: dict[str, Any] = {}

    def until(self, condition: Callable[[], object], timeout_s: float = START_S) -> None:
        """Spin until a condition holds; fail after the timeout."""
        assert self.holds(condition, timeout_s), f'timeout with {_seen(condition)}'

    def holds(self, condition: Callable[[], object], timeout_s: float = START_S) -> bool:
        """Spin until a condition holds; False after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def call(
        self,
        kind: Any,
        name: str,
        timeout_s: float = START_S,
        again_s: float = 40.0,
        **fields: Any,
    ) -> Any:
        """Call by a client that stays, again if unanswered: discovery may lose an answer."""
        if name not in self._services:
            self._services[name] = self.node.create_client(kind, name)
        self.until(self._services[name].service_is_ready, timeout_s)
        return self.ask(self._services[name], kind.Request(**fields), timeout_s, again_s)

    def ask(
        self, service: Any, request: Any, timeout_s: float = START_S, again_s: float = 40.0
    ) -> Any:
        """Call a service that is ready; without an answer after some time, call it once more."""
        asked = [service.call_async(request)]
        again_s += time.monotonic()

        def is_answered() -> bool:
            if len(asked) == 1 and time.monotonic() > again_s:
                asked.append(service.call_async(request))
            return any(future.done() for future in asked)

        self.until(is_answered, timeout_s)
        return next(future.result() for future in asked if future.done())

    def collect(self, kind: Any, topic: str, qos: Any = 1000) -> list[Any]:
        """Return a list that collects the messages of a topic."""
        found: list[Any] = []
        self.node.create_subscription(kind, topic, found.append, qos)
        return found

    def latched(self, kind: Any, topic: str) -> list[Any]:
        return self.collect(kind, topic, latched_qos())

    def until_latched(self, kind: Any, topic: str) -> list[Any]:
        """Wait for a message of a latched topic; return the list that collects them."""
        found = self.latched(kind, topic)
        self.until(lambda: found)
        return found

    def publisher(self, kind: Any, topic: str, depth: int = 1000) -> Any:
        """Return a publisher with at least one matched subscriber."""
        publisher = self.node.create_publisher(kind, topic, depth)
        self.until(publisher.get_subscription_count)
        return publisher

    def until_listened(self, name: str = 'star_observer', listeners: int = 1) -> None:
        """Wait for subscribers: discovery is not symmetric, and earlier messages are lost."""
        self.until(lambda: int(self.health(name)[2].get('listeners', 0)) >= listeners)

    def health(self, name: str = 'star_observer') -> tuple[bytes, str, dict[str, str]]:
        """Level, message and values of the latest diagnostics of a node; empty before them."""
        from diagnostic_msgs.msg import DiagnosticArray

        if self._diagnostics is None:
            self._diagnostics = self.collect(DiagnosticArray, '/diagnostics')
        for message in reversed(self._diagnostics):
            for status in message.status:
                if status.name == f'starcal: {name}':
                    pairs = [(value.key, value.value) for value in status.values]
                    assert len(dict(pairs)) == len(pairs), 'a key twice'
                    return status.level, status.message, dict(pairs)
        return b'', '', {}

    def forget_health(self) -> None:
        """Leave out diagnostics that came before."""
        if self._diagnostics is not None:
            self._diagnostics.clear()

    def until_value(self, key: str, value: str, name: str = 'star_observer') -> None:
        self.until(lambda: self.health(name)[2].get(key) == value)

    def statuses(self) -> list[Any]:
        if self._statuses is None:
            from starcal.msg import EnsembleStatus

            self._statuses = self.latched(EnsembleStatus, 'ensemble_status')
        return self._statuses

    def until_images(self, images: int, key: str = 'images') -> Any:
        """Wait until a calibrator reports so many images; return its status."""
        found = self.statuses()
        self.until(lambda: found and getattr(found[-1], key) == images)
        return found[-1]

    def fill(self, images: Sequence[Any]) -> None:
        """Publish observations to a calibrator; wait until it has all of them."""
        from starcal.msg import StarObservations
        from starcal_ros.formats.messages.record_messages import observations_to_message
        from starcal_ros.ros.node import make_message

        publisher = self.publisher(StarObservations, 'observations')
        for image in images:
            publisher.publish(observations_to_message(image, 'camera', make_message))
        self.until_images(len(images))

    def close(self) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


class Vehicle(Client):
    """A client of nodes that it starts, with the parameter file of the small bag by default."""

    def __init__(self, start_node: StartNode, bag: Path) -> None:
        super().__init__()
        self.start_node, self.bag = start_node, bag

    def start(
        self, name: str, *values: str, ros: tuple[str, ...] = (), forked: bool = True
    ) -> NodeProcess:
        return self.start_node(name, *parameters(self.bag, *values), *ros, forked=forked)

    def start_filled(self, *values: str) -> NodeProcess:
        node = self.start('calibrator', *values)
        self.fill(tiny_observations().images)
        return node

    def start_player(self, bag: Path, *values: str, ros: tuple[str, ...] = ()) -> NodeProcess:
        """Start to play a bag at full speed."""
        given = [word for value in (f'bag:={bag}', *values) for word in ('-p', value)]
        return self.start_node('bag_player', '-p', 'rate:=0.0', *given, *ros)

    def play(self, bag: Path, *values: str) -> NodeProcess:
        """Play a bag at full speed to its end."""
        player = self.start_player(bag, *values)
        assert player.wait() == 0, player.said()
        return player

    def calibrate(self) -> None:
        from std_srvs.srv import Trigger

        answer = self.call(Trigger, '/calibrator/calibrate')
        assert answer.success, answer.message


@functools.cache
def tiny_observations() -> Any:
    """Simulated observations of scenario tiny, without pixels."""
    from starcal_ground.simulation.centroids import true_observations
    from starcal_ground.simulation.scenario import scenario

    return true_observations(scenario('tiny'))


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
