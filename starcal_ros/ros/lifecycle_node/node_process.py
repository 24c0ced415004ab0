# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A node as a process: it runs until a signal tells it to end, and ends without a traceback."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import signal
import sys
from typing import Any

import rclpy
from rclpy.exceptions import ROSInterruptException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node

from starcal_ros.errors import StarcalError
from starcal_ros.ros.lifecycle_node.lifecycle import one_line, StarcalNode
from starcal_ros.ros.lifecycle_node.parameters import unread_sections

# Images, attitudes, services, solve, driver, its answer, two spare: none waits for another.
_THREADS = 8


class Executor(MultiThreadedExecutor):
    """
    Calls the callbacks of a node in threads of its own.

    ROS may be shut down while it is constructed; `__del__` of rclpy then looks for an attribute
    that is not there yet, and Python prints a traceback.
    """

    _sigint_gc: Any = None

    def join(self) -> None:
        """
        Wait for the callbacks that run, and drop those that wait for a thread.

        `shutdown` would also destroy the guard condition that the thread which answers signals
        triggers.
        """
        self._executor.shutdown(wait=True, cancel_futures=True)


def run(make_node: Callable[[], StarcalNode], name: str, args: Sequence[str] | None) -> int:
    """
    Run a lifecycle node until shutdown; return its exit status.

    0 after SIGINT or SIGTERM; 2 for bad parameters or files, with a one-line message.
    """
    node: StarcalNode | None = None
    # Destroyed after the end, with the thread in which rclpy answers signals: the thread triggers
    # a guard condition of each executor, and another signal may come while one is destroyed.
    executor: Executor | None = None

    def work() -> int:
        nonlocal node, executor
        node = make_node()
        given = sys.argv if args is None else args
        for text in unread_sections(given, node.get_fully_qualified_name(), name):
            node.get_logger().warning(text)
        executor = Executor(_THREADS)
        executor.add_node(node)
        if node.options.values()['autostart'] and not _start(node):
            raise StarcalError(node.failure)
        _spin(node, executor)
        return 0

    return until_told_to_end(name, args, work, lambda: _end(node, executor))


def until_told_to_end(
    name: str, args: Sequence[str] | None, work: Callable[[], int], end: Callable[[], None]
) -> int:
    """
    Run a function between `rclpy.init` and shutdown; return the exit status.

    That of the function, or 0 after SIGINT or SIGTERM, or 2 with a one-line message after an
    error.
    """
    is_up = False
    told = _record_signals()
    try:
        rclpy.init(args=None if args is None else [name, *args])
        is_up = True
        # Before `rclpy.init` no handler of ROS was there to shut the context down.
        return 0 if told else work()
    except (ExternalShutdownException, ROSInterruptException):
        return 0
    except Exception as error:
        # A signal shuts ROS down at once; an object under construction then fails.
        if is_up and not rclpy.ok():
            return 0
        print(f'{name}: {one_line(error)}', file=sys.stderr)
        return 2
    finally:
        end()


def _record_signals() -> list[int]:
    """
    Handle SIGINT and SIGTERM by adding them to the list returned, and by nothing else.

    The handler of rclpy calls this one and shuts the context down, which ends every loop.  A
    KeyboardInterrupt in its place may hit the entry of a `threading.Condition` of the executor;
    its lock is then never released, and the threads that wait for it never end
    (python/cpython#74174).
    """
    told: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, _frame: told.append(number))
    return told


def shut_down() -> None:
    """
    Leave ROS, though the thread in which rclpy answers signals may do so at the same time.

    `rclpy.try_shutdown` asks whether ROS is up and then shuts it down; where the thread comes in
    between, rcl has an error.
    """
    try:
        rclpy.try_shutdown()
    except RuntimeError:
        rclpy.try_shutdown()


def end_quietly(node: Node | None) -> None:
    """Destroy a node and leave ROS; a second signal does not interrupt it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    if node is not None:
        node.destroy_node()
    shut_down()


def _end(node: StarcalNode | None, executor: Executor | None) -> None:
    if node is not None:
        node.deactivate()
        node.cleanup()
    if executor is not None:
        executor.join()  # a callback that asks a destroyed node for its state crashes in rclpy
    end_quietly(node)


def _start(node: StarcalNode) -> bool:
    success = TransitionCallbackReturn.SUCCESS
    return bool(node.trigger_configure() == success and node.trigger_activate() == success)


def _spin(node: StarcalNode, executor: Executor) -> None:
    while node.context.ok():
        try:
            executor.spin_once(timeout_sec=1.0)
        except ExternalShutdownException:
            return
        except Exception as error:
            node.count_error(error)
