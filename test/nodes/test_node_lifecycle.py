# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Every transition in every state of both nodes, and the end by a signal in each state."""

import ctypes
import random
import signal
import threading
import time
from typing import Any

from lifecycle_msgs.msg import Transition
from managers import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Manager, NO_TRANSITION  # type: ignore[import-not-found]
import pytest
import rclpy
from starcal_tool import run_python  # type: ignore[import-not-found]
from std_msgs.msg import Empty
from vehicle import BOTH, parameters  # type: ignore[import-not-found]

from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.node import Executor

pytestmark = pytest.mark.nodes

NUMBERS = sorted(
    {value for name in dir(Transition) if isinstance(value := getattr(Transition, name), int)}
)
SHUTDOWN = {
    'unconfigured': Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    'inactive': Transition.TRANSITION_INACTIVE_SHUTDOWN,
    'active': Transition.TRANSITION_ACTIVE_SHUTDOWN,
}
PATHS = {'unconfigured': (), 'inactive': (CONFIGURE,), 'active': (CONFIGURE, ACTIVATE)}
# What a state allows but the shutdown: there, where it leads, and the way back.
ALLOWED: dict[str, tuple[tuple[int, str, tuple[int, ...]], ...]] = {
    'unconfigured': ((CONFIGURE, 'inactive', (CLEANUP,)),),
    'inactive': ((CLEANUP, 'unconfigured', (CONFIGURE,)), (ACTIVATE, 'active', (DEACTIVATE,))),
    'active': ((DEACTIVATE, 'inactive', (ACTIVATE,)),),
    'finalized': (),
}


def try_everything(manager: Manager, state: str) -> None:
    """Try every transition: valid ones are made, the others are refused without effect."""
    own = {number for number, _, _ in ALLOWED[state]} | {SHUTDOWN.get(state)}
    for number in (*NUMBERS, NO_TRANSITION):
        if number not in own:
            assert not manager.change(number), number
    # Where one of them had led elsewhere, the node would have made another from there.
    assert manager.state() == state
    for number, reached, back in ALLOWED[state]:
        assert manager.change(number)
        assert manager.state() == reached
        assert all(manager.change(step) for step in back)
        assert manager.state() == state


@pytest.mark.parametrize('shut_down', [False, True])
@pytest.mark.parametrize('state', PATHS)
def test_every_transition_in_every_state(vehicle, state, shut_down) -> None:
    # An interpreter of its own ends with all threads and publishers where the node was active.
    nodes = [vehicle.start(name, 'autostart:=false', forked=state != 'active') for name in BOTH]
    # Each state meets both signals; the two nodes end by the same code.
    signals = [signal.SIGINT, signal.SIGTERM]
    for node, number in zip(nodes, signals[::-1] if shut_down else signals, strict=True):
        manager = Manager(vehicle, node.name)
        assert all(manager.change(step) for step in PATHS[state])
        if shut_down:
            assert manager.change(SHUTDOWN[state])
        else:
            try_everything(manager, state)
        reached = 'finalized' if shut_down else state
        assert manager.state() == reached
        if shut_down and state == 'active':
            try_everything(manager, reached)
        assert node.stop(number) == 0, node.said()
        assert 'Traceback' not in node.said()


def run(code: str, *arguments: str) -> tuple[int, str, str]:
    done = run_python('-c', code, *arguments)
    return done.returncode, done.stdout, done.stderr


# Each is a process of its own, which has these.
OF_A_NODE = """
import ctypes, os, signal, sys, time
import rclpy
from starcal_ros.ros import node

def tell(*numbers):
    for number in numbers:
        os.kill(os.getpid(), number)
    time.sleep(0)  # where Python runs the handlers

def until_shut_down():
    while rclpy.ok():
        time.sleep(0.01)

def run(work, end=lambda: node.end_quietly(None)):
    sys.exit(node.until_told_to_end('maker', [], work, end))
"""
FAILS = """
def work():
    if 'told' in sys.argv:
        tell(signal.SIGTERM)
        until_shut_down()
    raise RuntimeError('the context\\nis invalid\x1b[2J')
run(work)
"""
TOLD_AGAIN = """
several = signal.SIGINT, signal.SIGTERM, signal.SIGINT
def work():
    tell(*several)
    until_shut_down()
def end():
    tell(*several)
    node.end_quietly(None)
    tell(*several)
    print('ended')
run(work, end)
"""
AT_AN_ENTRY = """
class Lock:
    def __enter__(self):
        tell(signal.SIGTERM)
    def __exit__(self, *_):
        print('released')
def work():
    with Lock():
        pass
    until_shut_down()
    return 0
if 'early' in sys.argv:
    init = rclpy.init
    rclpy.init = lambda args: (tell(signal.SIGTERM), init(args=args))
run(work)
"""
NEVER_LET_GO = """
class Held:
    def destroy_node(self):
        ctypes.PyDLL(None).sleep(60)  # keeps the lock of the interpreter, as the middleware does
node._END_S = 1
rclpy.init()
node.end_quietly(Held())
"""
EXECUTOR_AFTER_THE_SHUTDOWN = """
rclpy.init()
rclpy.shutdown()
try:
    node.Executor(2)
except Exception:
    print('refused')
"""
SHUT_DOWN_TWICE = """
signal.signal(signal.SIGTERM, lambda *_: None)
for _ in range(10_000):
    rclpy.init()
    os.kill(os.getpid(), signal.SIGTERM)
    node.shut_down()
"""
# Code, an argument, and exit status, output and error of the process.
ENDS = {
    'an error is one line': (
        FAILS, '', (2, '', 'maker: the context is invalid\\x1b[2J\n'),
    ),
    'what fails after a signal is no error': (FAILS, 'told', (0, '', '')),
    'further signals do not cut the end short': (TOLD_AGAIN, '', (0, 'ended\n', '')),
    # A KeyboardInterrupt there would leave it taken, and the threads that need it never end.
    'a signal leaves no lock taken': (AT_AN_ENTRY, '', (0, 'released\n', '')),
    'a signal before ROS has started': (AT_AN_ENTRY, 'early', (0, '', '')),
    'the middleware never lets a node go': (NEVER_LET_GO, '', (-signal.SIGALRM, '', '')),
    'a signal while the executor is constructed': (
        EXECUTOR_AFTER_THE_SHUTDOWN, '', (0, 'refused\n', ''),
    ),
    # `rclpy.try_shutdown` alone fails once in some hundred times: the signal was faster.
    'a signal shuts ROS down at the same time': (SHUT_DOWN_TWICE, '', (0, '', '')),
}  # fmt: skip


@pytest.mark.parametrize('name', ENDS)
def test_a_node_ends_by_signals_and_errors(name) -> None:
    code, argument, expected = ENDS[name]
    assert run(OF_A_NODE + code, argument) == expected


INTERRUPTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
class Interrupt:
    def find_spec(self, name, *_):
        if name == 'starcal_ros.pipeline.setup':
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupt())
from starcal_ros import entry_points
entry_points.calibrator()
"""


def test_a_signal_while_python_imports_ends_it_without_a_traceback() -> None:
    """Ctrl-C at the console script."""
    assert run(INTERRUPTED) == (-signal.SIGINT, '', '')


EXECUTOR_OF_A_NODE = """
import os, signal, sys
import rclpy
from starcal_ground.ros import bag_player
from starcal_ros.ros import calibrator
from starcal_ros.ros import node as node_module

def told_of(module, name):
    kind = getattr(module, name)
    def destroyed(executor):
        print('executor destroyed')
        kind.__del__(executor)
    setattr(module, name, type(name, (kind,), {'__del__': destroyed}))

shut_down = rclpy.try_shutdown
def end():
    shut_down()
    print('signals answered no more')
rclpy.try_shutdown = end
told_of(node_module, 'Executor')
node_module._spin = lambda node, executor: os.kill(os.getpid(), signal.SIGTERM)
bag_player.BagPlayer.play = lambda player: os.kill(os.getpid(), signal.SIGTERM) or 0
node = {'calibrator': calibrator, 'bag_player': bag_player}[sys.argv.pop(1)]
node.main(sys.argv[1:])
"""


@pytest.mark.parametrize('name', ['calibrator', 'bag_player'])
def test_an_executor_outlives_the_thread_that_answers_signals(name, tiny_bag) -> None:
    """The thread triggers a condition of each executor, and may find it half destroyed."""
    parameters = ['-p', f'bag:={tiny_bag}'] if name == 'bag_player' else ['-p', 'autostart:=false']
    status, out, error = run(EXECUTOR_OF_A_NODE, name, '--ros-args', *parameters)
    lines = [line for line in out.splitlines() if line]
    assert (status, error) == (0, '')
    assert lines.index('executor destroyed') > lines.index('signals answered no more')


def test_no_event_ends_a_wait_while_a_message_waits_for_a_thread(client) -> None:
    """The middleware shows events of a subscription as ready until its message is taken."""
    context = client.node.context
    executor, node = Executor(2, context=context), rclpy.create_node('waits', context=context)
    executor.add_node(node)
    free, taken = threading.Event(), list[Any]()
    subscription: Any = node.create_subscription(Empty, 'waits', taken.append, 1)
    publisher = node.create_publisher(Empty, 'waits', 1)

    def may_wait_for_events() -> bool:
        executor.spin_once(timeout_sec=0.1)
        return all(executor.can_execute(event) for event in subscription.event_handlers)

    def is_due() -> bool:
        publisher.publish(Empty())
        return not may_wait_for_events() and bool(subscription._executor_event)

    try:
        for _ in range(2):
            executor._executor.submit(free.wait)
        client.until(is_due)
        assert not any(executor.can_execute(event) for event in subscription.event_handlers)
        assert subscription.event_handlers and not taken
        free.set()
        client.until(lambda: may_wait_for_events() and bool(taken))
    finally:
        free.set()
        executor.shutdown()
        node.destroy_node()


def test_an_error_while_a_message_is_taken_frees_its_group(client) -> None:
    """As where a subscription is destroyed meanwhile: others of the group are called again."""
    context = client.node.context
    executor, node = Executor(2, context=context), rclpy.create_node('fails', context=context)
    subscription: Any = node.create_subscription(Empty, 'fails', print, 1)
    other = node.create_subscription(Empty, 'others', print, 1)

    def fails(_entity: object) -> None:
        raise RuntimeError('it was destroyed')

    try:
        task = executor._make_handler(subscription, node, fails)
        assert not executor.can_execute(other)
        task()
        with pytest.raises(RuntimeError, match='it was destroyed'):
            task.result()
        assert executor.can_execute(subscription) and executor.can_execute(other)
    finally:
        executor.shutdown()
        node.destroy_node()


ARENAS_OF_A_NODE = """
import ctypes, sys, threading, types
from starcal_ros import entry_points
libc = ctypes.CDLL(None)
libc.malloc.restype = ctypes.c_void_p

def main():
    import rclpy
    rclpy.init()
    for _ in range(8):
        threads = [threading.Thread(target=libc.malloc, args=[100_000]) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, 'stdout'))
    libc.fflush(None)
    return 0

sys.modules['starcal_ros.ros.calibrator'] = types.SimpleNamespace(main=main)
entry_points.calibrator()
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), 'malloc_info'), reason='glibc alone has it')
def test_threads_share_one_arena_of_memory() -> None:
    """Otherwise the memory of a node grows with the threads on which it has solved."""
    status, out, error = run(ARENAS_OF_A_NODE)
    assert (status, error) == (0, '') and out.count('<heap nr=') == 1


@pytest.mark.parametrize('seed', range(2))
def test_nodes_end_after_several_signals(vehicle, seed) -> None:
    """`ros2 launch` sends SIGINT to a node whose process group may have had one already."""
    rng = random.Random(seed)
    nodes = [vehicle.start(name, forked=False) for name in BOTH]
    managers = [Manager(vehicle, node.name) for node in nodes]
    vehicle.until(lambda: all(manager.state() == 'active' for manager in managers))
    for _ in range(rng.choice([2, 3])):
        for node in nodes:
            node.send(rng.choice([signal.SIGINT, signal.SIGINT, signal.SIGTERM]))
        # The end takes 0.1 s to 0.5 s: the next signal comes at once, or somewhere in it.
        time.sleep(rng.choice([0.0, 0.5 * rng.random()]))
    for node in nodes:
        assert node.wait() == 0, node.said()
        assert 'Traceback' not in node.said()


CALLBACK_AT_THE_END = """
import os
import signal
import sys
import threading

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.node import run

class Slow(Calibrator):
    destroyed = threading.Event()

    def activate(self):
        super().activate()
        self.steady_timer(0.01, self.slow, MutuallyExclusiveCallbackGroup())

    def slow(self):
        os.kill(os.getpid(), signal.SIGTERM)
        # The node was destroyed 0.1 s after the signal, before its end waited for callbacks.
        print('destroyed' if self.destroyed.wait(2.0) else 'a node', self.is_active)

    def destroy_node(self):
        super().destroy_node()
        self.destroyed.set()

sys.exit(run(Slow, 'calibrator', sys.argv[1:]))
"""


def test_a_callback_that_runs_at_the_end_has_a_node(tiny_bag) -> None:
    """In a destroyed one, rclpy crashes where the state is asked for."""
    status, out, error = run(CALLBACK_AT_THE_END, '--ros-args', *parameters(tiny_bag))
    assert status == 0, error
    assert out.startswith('a node ')


def test_a_destroyed_node_is_no_longer_in_the_graph(client, tiny_bag) -> None:
    """A process may hold several nodes, one after the other, with the same name."""
    rclpy.init(args=['--ros-args', *parameters(tiny_bag)])
    try:
        node = Calibrator()
        client.until(lambda: 'calibrator' in client.node.get_node_names())
        node.destroy_node()
        client.until(lambda: 'calibrator' not in client.node.get_node_names())
    finally:
        rclpy.try_shutdown()
