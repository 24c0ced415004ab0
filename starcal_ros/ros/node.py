# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Base class of the lifecycle nodes, the process that runs one, and messages of rclpy.

A node starts itself, survives callback errors and publishes diagnostics.  Its process runs until a
signal ends it, without a traceback.
"""

from __future__ import annotations

import array
from collections import Counter
from collections.abc import Callable, Sequence
import functools
import importlib
import math
import resource
import signal
import sys
import threading
import time
import traceback
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState
import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ROSInterruptException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile

from starcal_ros.errors import StarcalError
from starcal_ros.formats.messages.message_codec import Message
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES, Setup
from starcal_ros.processes import return_freed_memory
from starcal_ros.ros import inputs, parameters, printable_log
from starcal_ros.text import printable

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
Health = tuple[bytes, str, dict[str, object]]
NO_CLOCK = 'no /clock: start its publisher, or set use_sim_time to false'

_END_S = 30  # for the middleware to let a node go; on busy cores it takes a second
_ANSWERED_S = 1.0  # after a signal, by which the thread of rclpy has shut ROS down
_told: list[float] = []  # times of the signals
_SILENT_S = 5.0
_TRIM_S = 10.0


class StarcalNode(printable_log.PrintableLog, LifecycleNode):
    """
    Base class of the lifecycle nodes.

    Subclasses implement `configure`, `activate`, `deactivate`, `cleanup` and `health`.
    """

    _setup: Setup  # by `configure`

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.options = parameters.OptionParameters(self, (*OPTION_CLASSES, *NODE_OPTION_CLASSES))
        self.options.check_names()
        self.failure = ''  # why the last transition failed, one line
        self._publishers_made: list[Any] = []
        self.inputs = inputs.Inputs(self)
        self._incompatible: list[str] = []  # publishers that are not received
        self._quiet: dict[str, str] = {}  # by silent topic: why, or others that have a publisher
        self._errors = 0
        self._taken: Counter[Callable[[Any], None]] = Counter()
        self._counting = threading.Lock()  # guards the counts of errors and messages
        self._level: bytes | None = None
        self._silent_from_s = math.inf
        self._trim_due_s = 0.0
        self._diagnostics_lock = threading.Lock()
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self._diagnostics_timer = self.steady_timer(
            1.0, self.guarded(self._each_second), MutuallyExclusiveCallbackGroup()
        )
        self._answer_where_rclpy_raises()

    def destroy_node(self) -> None:
        """Leave the graph too: rclpy keeps the node in it as long as the state machine exists."""
        # First, as rclpy destroys all that depends on a node before its handle: the five services
        # that the state machine has share it, and the last one that is destroyed ends it.  The
        # other order crashed once on Kilted.  In either order Fast DDS of Kilted may not return
        # (some of a thousand ends beside other processes): `end_quietly` then ends the process.
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def configure(self) -> None:
        """Read parameters and files, create the publishers; StarcalError if they are invalid."""
        raise NotImplementedError

    def activate(self) -> None:
        """Create the subscriptions and services."""
        raise NotImplementedError

    def deactivate(self) -> None:
        """Destroy the subscriptions and services; may be called twice."""
        raise NotImplementedError

    def publisher(self, kind: Any, topic: str, qos: QoSProfile) -> Any:
        """Return a publisher that `cleanup` destroys."""
        made = self.create_lifecycle_publisher(kind, topic, qos)
        self._publishers_made.append(made)
        return made

    def cleanup(self) -> None:
        """Destroy the publishers; may be called twice."""
        while self._publishers_made:
            self.destroy_lifecycle_publisher(self._publishers_made.pop())

    def health(self) -> Health:
        """Return level, message and values of the diagnostics of the active node."""
        raise NotImplementedError

    def needed(self) -> list[str]:
        """Return the topics that the node cannot do without, by their names on the graph."""
        return []

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters; an unknown name is refused with a similar one, which rclpy has not."""
        if why := self.options.why_unknown(one.name for one in parameter_list):
            return SetParametersResult(successful=False, reason=why)
        return super().set_parameters_atomically(parameter_list)

    def taken(self, callback: Callable[[Any], None]) -> int:
        """Return the number of messages that a callback, wrapped by `taking`, has had."""
        return self._taken[callback]

    @property
    def is_active(self) -> bool:
        """True in the lifecycle state active."""
        return bool(self._state_machine.current_state[1] == 'active')

    def steady_timer(self, period_s: float, callback: Callable[[], None], group: Any) -> Any:
        """Return a timer that runs in simulated time too, while nobody publishes /clock."""
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        return self.create_timer(period_s, callback, group, clock)

    def guarded(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return the callback wrapped so that its errors are logged and counted."""

        @functools.wraps(callback)
        def run(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                self.count_error(error)

        return run

    def taking(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return the guarded callback of an input, which counts messages when it has ended."""
        guarded = self.guarded(callback)

        def run(message: Any) -> None:
            guarded(message)
            with self._counting:
                self._taken[callback] += 1

        return run

    def count_error(self, error: Exception) -> None:
        """Log an unexpected error and count it for the diagnostics."""
        if not self.context.ok():
            return  # at shutdown, handles are destroyed under running callbacks
        with self._counting:
            self._errors += 1
        frames = traceback.extract_tb(error.__traceback__)
        place = f' in {frames[-1].name}, line {frames[-1].lineno}' if frames else ''
        self.get_logger().error(f'{type(error).__name__}: {one_line(error)}{place}')

    def _each_second(self) -> None:
        incompatible = self.inputs.incompatible()
        for text in set(incompatible) - set(self._incompatible):
            self.get_logger().warning(f'not received: {text}')
        self._incompatible = incompatible
        if time.monotonic() > self._trim_due_s:
            self._trim_due_s = time.monotonic() + _TRIM_S
            return_freed_memory()
        self._look_for_silence()
        self.publish_health()

    def _look_for_silence(self) -> None:
        """Take note of the needed topics that sent nothing yet, or nothing any more."""
        before, self._quiet = self._quiet, {}
        if not self.is_active or time.monotonic() < self._silent_from_s:
            return
        for topic in self.needed():
            why = self.inputs.ended(topic, _SILENT_S)
            if not why and self.inputs.has_come(topic):
                continue
            if topic not in before:
                publishers = self.count_publishers(topic)
                never = f'no message in {_SILENT_S:.0f} s, from {publishers} publishers'
                self.get_logger().warning(f'{topic}: {why or never}')
            self._quiet[topic] = why or self.inputs.elsewhere(topic)

    def publish_health(self) -> None:
        """Publish the diagnostics now."""
        if not self.context.ok():
            return
        level, text, numbers = self._health()
        status = DiagnosticStatus(
            level=level,
            name=f'starcal: {self.get_fully_qualified_name()[1:]}',
            message=text,
            hardware_id=self.get_fully_qualified_name(),
            values=[KeyValue(key=key, value=str(value)) for key, value in numbers.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        with self._diagnostics_lock:
            self._level = level
            self._diagnostics.publish(message)

    def publish_health_change(self) -> None:
        """Publish the diagnostics if their level has changed."""
        if self._health()[0] != self._level:
            self.publish_health()

    def _health(self) -> Health:
        if self.is_active:
            level, text, numbers = self.health()
            doubts = [f'not received: {"; ".join(self._incompatible)}'] * bool(self._incompatible)
            doubts += [f'{topic}: {why}' for topic, why in list(self._quiet.items()) if why]
            if level != ERROR and self._waits_for_clock():
                level, text = WARN, NO_CLOCK
            elif level != ERROR and doubts:
                level, text = WARN, '; '.join([*([text] * (level == WARN)), *doubts])
        else:
            state = self._state_machine.current_state[1]
            level, text, numbers = WARN, self.failure or f'not active: {state}', {}
            if self.failure:
                level = ERROR
        peak_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB on Linux
        common = {
            'memory_peak_mb': peak_kb // 1000,
            'messages': sum(list(self._taken.values())),
            'callback_errors': self._errors,
        }
        return level, text, {**numbers, **common}

    def _waits_for_clock(self) -> bool:
        """Return True in simulated time before the first message of /clock."""
        is_simulated = bool(self.get_parameter('use_sim_time').value)
        return is_simulated and not self.get_clock().now().nanoseconds

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Configure; with a bad parameter or file the node stays unconfigured."""
        self.options.frozen = True
        outcome = self._transition(self.configure, state, super().on_configure)
        if outcome == TransitionCallbackReturn.SUCCESS:
            self.get_logger().info(f'configured, {self._prior_in_words()}')
        else:
            self.options.frozen = False
        return outcome

    def _prior_in_words(self) -> str:
        frames, camera = self._setup.frames, self._setup.prior.camera
        width_deg = math.degrees(2 * math.atan(camera.width / 2 / float(camera.parameters[0])))
        alignment = [round(number, 6) for number in frames.prior_alignment]
        return (
            f'prior camera {frames.camera_info_url}: {camera.width} x {camera.height},'
            f' {width_deg:.1f} degrees wide; prior_alignment'
            f' {alignment if self._setup.is_aligned else "not given"}'
        )

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Activate: publishers first, then subscriptions."""
        outcome = super().on_activate(state)
        outcome = self._transition(self.activate, state, lambda _: outcome)
        if outcome == TransitionCallbackReturn.FAILURE:
            self.deactivate()
            super().on_deactivate(state)
        elif outcome == TransitionCallbackReturn.SUCCESS:
            self._silent_from_s = time.monotonic() + _SILENT_S
            self.get_logger().info(f'active, listening to {", ".join(self.inputs.names())}')
        return outcome

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Deactivate: subscriptions first, then publishers."""
        return self._transition(self.deactivate, state, super().on_deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Clean up; parameters may be changed again."""
        outcome = self._transition(self.cleanup, state, super().on_cleanup)
        self.options.frozen = False
        return outcome

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Shut down from any state."""
        self.deactivate()
        return self._transition(self.cleanup, state, super().on_shutdown)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured after a transition that failed halfway."""
        self.deactivate()
        self.cleanup()
        self.options.frozen = False
        return TransitionCallbackReturn.SUCCESS

    def _transition(
        self, step: Callable[[], None], state: LifecycleState, base: Callable[[Any], Any]
    ) -> TransitionCallbackReturn:
        # Jazzy discards exceptions of a transition silently: log them here.
        try:
            step()
        except StarcalError as error:
            self.failure = one_line(error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.failure = f'{type(error).__name__}: {one_line(error)}'
            self.count_error(error)
            return TransitionCallbackReturn.ERROR
        self.failure = ''
        return base(state)

    def _answer_where_rclpy_raises(self) -> None:
        """Refuse an invalid transition (Jazzy) and a parameter of an invalid type by an answer."""

        def answering(respond: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
            def answer(request: Any, response: Any) -> Any:
                try:
                    response = respond(request, response)
                except Exception as error:
                    self.get_logger().error(f'request refused: {one_line(error)}')
                    _refuse(request, response, one_line(error))
                is_transition = isinstance(response, ChangeState.Response)
                if self.failure and is_transition and not response.success:
                    self.get_logger().error(self.failure)
                if is_transition:
                    self.guarded(self.publish_health_change)()
                return response

            return answer

        for service in self.services:
            if service.srv_type in (ChangeState, SetParameters, SetParametersAtomically):
                service.callback = answering(service.callback)


def _refuse(request: Any, response: Any, why: str) -> None:
    refused = SetParametersResult(successful=False, reason=why)
    if isinstance(response, ChangeState.Response):
        response.success = False
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = refused
    else:
        # Parameters before the bad one are answered and may be set.
        unanswered = len(request.parameters) - len(response.results)
        response.results = [*response.results, *[refused] * unanswered]


def one_line(error: Exception) -> str:
    """Return the text of an error in one line that is safe to print."""
    return printable(' '.join(str(error).split()))


# Images, attitudes, services, solve, driver, its answer, two spare: none waits for another.
_THREADS = 8


class Executor(MultiThreadedExecutor):
    """
    Calls the callbacks of a node in threads of its own.

    ROS may be shut down while it is constructed; `__del__` of rclpy then looks for an attribute
    that is not there yet, and Python prints a traceback.
    """

    _sigint_gc: Any = None
    _due: tuple[Any, ...] = ()  # their callbacks may not have begun

    def _make_handler(self, entity: Any, node: Any, take: Callable[[Any], Any]) -> Any:
        def taking(due: Any) -> Any:
            # After an error here, rclpy would never free the group.
            try:
                return take(due)
            except Exception as error:
                return functools.partial(_raise, error)

        self._due = (*(other for other in self._due if other._executor_event), entity)
        return super()._make_handler(entity, node, taking)

    def can_execute(self, entity: Any) -> bool:
        """
        Return True if a callback may begin, and no other of its group is about to.

        Until a thread has taken a message, the events of its subscription would end each wait.
        """
        groups = [other.callback_group for other in self._due if other._executor_event]
        return bool(super().can_execute(entity)) and entity.callback_group not in groups

    def join(self) -> None:
        """
        Wait for the callbacks that run, and drop those that wait for a thread.

        `shutdown` would also destroy the guard condition that the thread which answers signals
        triggers.
        """
        self._executor.shutdown(wait=True, cancel_futures=True)


async def _raise(error: Exception) -> None:
    raise error


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
        node.options.folders = parameters.folders_of_paths(given, node.get_fully_qualified_name())
        for text in parameters.unread_sections(given, node.get_fully_qualified_name(), name):
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


def _record_signals() -> list[float]:
    """
    Handle SIGINT and SIGTERM by adding their time to the list returned, and by nothing else.

    The handler of rclpy calls this one and shuts the context down, which ends every loop.  A
    KeyboardInterrupt in its place may hit the entry of a `threading.Condition` of the executor;
    its lock is then never released, and the threads that wait for it never end
    (python/cpython#74174).
    """
    _told.clear()
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda _number, _frame: _told.append(time.monotonic()))
    return _told


def is_overdue() -> bool:
    """
    Return True if a signal came that rclpy has not answered: a loop then ends by itself.

    During `rclpy.init` the handler of rclpy may meet no context to shut down, and the handler here
    be called after the question whether a signal came.
    """
    return bool(_told) and time.monotonic() > _told[0] + _ANSWERED_S


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
    """Destroy a node and leave ROS; a second signal does not interrupt it, and it ends in time."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    # The middleware may wait for a thread of its own for ever, with the lock of the interpreter
    # held, so that only the default action of a signal ends the process.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(_END_S)
    if node is not None:
        node.destroy_node()
    shut_down()
    signal.alarm(0)


def _end(node: StarcalNode | None, executor: Executor | None) -> None:
    if node is not None:
        node.deactivate()
        node.cleanup()
    if executor is not None:
        executor.join()  # a callback that asks a destroyed node for its state crashes in rclpy
    end_quietly(node)


def _start(node: StarcalNode) -> bool:
    success = TransitionCallbackReturn.SUCCESS
    is_active = node.trigger_configure() == success and node.trigger_activate() == success
    node.guarded(node.publish_health_change)()
    return bool(is_active)


def _spin(node: StarcalNode, executor: Executor) -> None:
    while node.context.ok() and not is_overdue():
        try:
            executor.spin_once(timeout_sec=1.0)
        except ExternalShutdownException:
            return
        except Exception as error:
            if node.context.ok():  # else a signal came while a wait was under construction
                node.count_error(error)


def make_message(type_name: str, /, **fields: Any) -> Message:
    """
    Return a generated message of type ``'pkg/msg/Name'`` with the given fields.

    The ``make`` argument of the functions in `formats.messages`.
    """
    message_class, kinds = _class_and_kinds(type_name)
    return message_class(**{name: _as_field(value, kinds[name]) for name, value in fields.items()})


@functools.lru_cache(maxsize=64)
def message_class(type_name: str) -> Any:
    """Generated class of a type; raises ImportError if there is none of this name installed."""
    package, _, name = type_name.partition('/msg/')
    try:
        kind = getattr(importlib.import_module(f'{package}.msg'), name)
    except (AttributeError, TypeError) as error:  # no such class; no package
        raise ImportError(f'{package} has no {name}') from error
    if not isinstance(kind, type):  # a module within the package
        raise ImportError(f'{type_name} is no type of a message')
    return kind


@functools.lru_cache(maxsize=64)
def _class_and_kinds(type_name: str) -> tuple[Any, dict[str, str]]:
    kind = message_class(type_name)
    return kind, kind.get_fields_and_field_types()


def _as_field(value: Any, kind: str) -> Any:
    if not isinstance(value, np.ndarray) or not kind.startswith('sequence'):
        return value  # rclpy also uses numpy for fixed-size arrays
    # rclpy assigns an array.array without conversion: 0.6 ms for 8 MB; an ndarray takes 540 ms.
    numbers = array.array(value.dtype.char.replace('l', 'q'))  # 64 bit have one code in rclpy
    numbers.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
    return numbers
