# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrator node: subscribes to star observations, publishes calibrations, to a camera too."""

from __future__ import annotations

import array
from collections.abc import Sequence
import contextlib
from dataclasses import replace
import math
import sys
import threading
import time
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import Trigger

from starcal.msg import Calibration as CalibrationMessage
from starcal.msg import EnsembleStatus as StatusMessage
from starcal.msg import StarObservations as ObservationsMessage
from starcal.srv import Calibrate, LineOfSightTable
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.formats.messages.message_codec import IMAGE_TYPE, make_header, record_to_message
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_to_message,
    camera_info_to_message,
    checked_observations,
    mountings_to_messages,
    none_active_to_messages,
    status_to_message,
)
from starcal_ros.options import from_mapping
from starcal_ros.pipeline.setup import CalibratorOptions, check_site, load_setup
from starcal_ros.records import IMAGE_REFUSALS
from starcal_ros.ros import node
from starcal_ros.ros.inputs import LATCHED
from starcal_ros.ros.state import Answer, CalibratorState
from starcal_ros.text import shortened

NAME = 'calibrator'
_NONE_REFUSED = dict.fromkeys(sorted(IMAGE_REFUSALS), 0)
# Deep enough to lose no image at one a second during a solve of minutes.
_OBSERVATIONS = QoSProfile(depth=1000)
_TRANSFORMS = 'tf2_msgs/msg/TFMessage'
# Every publisher of static transforms latches one message, and all of them are needed.
_ALL_LATCHED = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_TIMEOUT_S = 5.0  # longest wait for set_camera_info or its answer: a driver may write to flash
_LOOK_S = 0.5  # period of checks for the service and the timeout
_LONGEST_PAUSE_S = 300.0  # longest pause after the time limit, before a driver is called again
_RETRY_S = 1.0  # after a failed write
_STATUS_S = 0.25  # a burst of images is one status; idle, it costs 0.3 % of a processor
_MOST_CHARACTERS = 200  # longest answer: two lines of a terminal; the log has all of it
_TABLE_POINTS, _MAX_TABLE_POINTS = 25, 200  # pixels a side; 200 take 1 s and 2 MB


class Calibrator(node.StarcalNode):
    """
    Collects observations and calibrates on request, in a worker thread.

    `CalibratorState` holds the ensemble and the active calibration; the node publishes them.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._listeners: list[tuple[Any, Any]] = []
        self._publishing = threading.Lock()
        self._state = CalibratorState(self._now_ns, self._log_trouble)
        self._last_answer = Answer(True, '')
        self._last_gate = 'none'
        self._driver: CameraDriver | None = None
        self._status_is_due = threading.Event()
        solving, deciding = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        sending = MutuallyExclusiveCallbackGroup()
        # There in every state: a caller of a service that is not there waits for ever.
        for kind, name, answer, group in (
            (Trigger, '~/calibrate', self._on_calibrate, solving),
            (Calibrate, '~/solve', self._on_solve, solving),
            (Trigger, '~/reset', self._on_reset, deciding),
            (Trigger, '~/rollback', self._on_rollback, deciding),
            (LineOfSightTable, '~/lookup', self._on_lookup, sending),
        ):
            self.create_service(kind, name, self._answered(answer), callback_group=group)

    def configure(self) -> None:
        """Load the prior camera, options and state folder, create the latched publishers."""
        values = self.options.values()
        self._own = from_mapping(CalibratorOptions, values)
        self._setup = load_setup(values)
        check_site(self._setup.site)
        self._state.open(self._setup, self._own)
        self.get_logger().info(str(self._state))
        for text in (*self._state.damage, *self._state.withheld.values()):
            self.get_logger().error(text)
        # Answers and verdicts use today's parameters: the gate judges stored calibrations again.
        self._last_answer, active = Answer(True, ''), self._state.active
        self._last_gate = 'none'
        if self._state.withheld:
            self._last_gate = f'refused: {next(iter(self._state.withheld.values()))}'
        elif active is not None:
            self._note_gate(Answer(True, '', active))
        self._camera_info = self.publisher(CameraInfo, 'camera_info', LATCHED)
        self._alignment = self.publisher(TransformStamped, 'alignment', LATCHED)
        self._calibration = self.publisher(CalibrationMessage, 'calibration', LATCHED)
        self._candidate = self.publisher(CalibrationMessage, 'candidate_calibration', LATCHED)
        self._status = self.publisher(StatusMessage, 'ensemble_status', LATCHED)
        self._tf_static = None
        self._own_transforms: list[Any] = []
        self._foreign_frames: set[str] = set()
        with contextlib.suppress(ImportError):  # tf2_msgs need not be installed
            kind = node.message_class(_TRANSFORMS)
            self._tf_static = self.publisher(kind, '/tf_static', LATCHED)

    def activate(self) -> None:
        """Start to collect observations and to serve requests."""
        collecting = MutuallyExclusiveCallbackGroup()
        if self._own.set_camera_info_service:
            self._driver = CameraDriver(self, self._own.set_camera_info_service)
        self.inputs.add(
            (ObservationsMessage,),
            'observations',
            self.taking(self._on_observations),
            _OBSERVATIONS,
            group=collecting,
        )
        if self._tf_static is not None:
            heard = self.create_subscription(
                node.message_class(_TRANSFORMS),
                '/tf_static',
                self.guarded(self._on_transforms),
                _ALL_LATCHED,
                callback_group=collecting,
            )
            self._listeners.append((self.destroy_subscription, heard))
        retry = self.steady_timer(_RETRY_S, self.guarded(self._save_again), collecting)
        # Not a guard condition: before ros2/rmw_fastrtps#895 a trigger during the wait of the
        # executor is lost, and with it the status of the last image.
        telling = MutuallyExclusiveCallbackGroup()
        status = self.steady_timer(_STATUS_S, self.guarded(self._publish_status), telling)
        self._listeners += [(self.destroy_timer, retry), (self.destroy_timer, status)]
        self._status_is_due.set()
        self._publish_active()

    def deactivate(self) -> None:
        """Stop collecting observations and serving requests."""
        if self._driver is not None:
            self._driver.close()
            self._driver = None
        self.inputs.close()
        while self._listeners:
            destroy, entity = self._listeners.pop()
            destroy(entity)

    def cleanup(self) -> None:
        """Destroy the publishers and close the state folder; the state stays in memory."""
        with self._publishing:
            super().cleanup()
        self._state.close()

    def health(self) -> node.Health:
        """Diagnostics: ensemble, active calibration and the result of the last request."""
        state, last = self._state, self._last_answer
        ensemble, active = state.ensemble, state.active
        free = state.disk_free_bytes()
        age_s: object = 'none'
        if active is not None:
            age_ns = self._now_ns() - active.active_since_ns
            age_s = round(age_ns / NANOSECONDS_PER_SECOND, 1)
        driver = self._driver
        numbers: dict[str, object] = {
            'images': len(ensemble.images),
            'stars': ensemble.star_count,
            **{
                f'refused_{reason}': count
                for reason, count in {**_NONE_REFUSED, **ensemble.refused}.items()
            },
            'active': 'none' if active is None else active.number,
            'calibration_age_s': age_s,
            'last_gate': self._last_gate,
            'last_answer': last.message,
            'camera_driver': 'none' if driver is None else driver.outcome,
            'camera_driver_failures': 0 if driver is None else driver.failures,
            'state_damaged_files': len(state.damage),
            'state_refused_calibrations': len(state.withheld),
            'disk_free_mb': 'none' if free is None else free // 1_000_000,
        }
        if state.trouble:
            return node.ERROR, f'state not saved, in memory only: {state.trouble}', numbers
        if state.withheld:
            return node.WARN, '; '.join(state.withheld.values()), numbers
        if active is not None and active.forced:
            return node.WARN, f'active despite the gate: {"; ".join(active.reasons)}', numbers
        topic = self.resolve_topic_name('calibration')
        if self.count_publishers(topic) > 1:
            return node.WARN, f'another node publishes {topic}', numbers
        if foreign := self._foreign_transforms():
            return node.WARN, foreign, numbers
        if state.damage:
            return node.WARN, f'set aside as damaged: {"; ".join(state.damage)}', numbers
        if driver is not None and driver.has_failed:
            return node.WARN, f'camera driver not updated: {driver.outcome}', numbers
        if not last.success:
            return node.WARN, last.message, numbers
        return node.OK, 'collecting' if active is None else 'calibration active', numbers

    def needed(self) -> list[str]:
        """Return the topic of the observations."""
        return [self.resolve_topic_name('observations')]

    def _with_silence(self, answer: Answer) -> Answer:
        """Return the answer with the reason, first, if no observations have come."""
        (topic,) = self.needed()
        if answer.success or self._state.ensemble.images or self.inputs.has_come(topic):
            return answer
        where = self.inputs.elsewhere(topic)
        if not where:
            images = self.inputs.published(IMAGE_TYPE)
            unread = [name for name in images if not self.count_subscribers(name)]
            where = ', '.join(f'{name} has a publisher and no subscriber' for name in unread)
        why = f'no message on {topic}' + (f': {where}' if where else '')
        return replace(answer, message=f'{why}; {answer.message}')

    def _foreign_transforms(self) -> str:
        """Return which transforms another node publishes as well; empty: none."""
        if not self._own_transforms or self.count_publishers('/tf_static') < 2:
            return ''
        names = ', '.join(sorted(self._foreign_frames))
        remedy = 'give each camera its own frames (camera_frame, more_star_trackers)'
        return names and f'/tf_static: another node publishes {names} too: {remedy}'

    def _on_transforms(self, message: Any) -> None:
        """Take note of the frames of this node to which another one publishes a transform."""
        mountings = (mounting.frame for mounting in self._setup.mountings)
        frames = {self._setup.frames.camera_frame, *mountings}
        with self._publishing:
            own = self._own_transforms
            frames |= {transform.child_frame_id for transform in own}
            names = {frame.lstrip('/') for frame in frames}
            heard = (sent.child_frame_id for sent in message.transforms if sent not in own)
            # A frame has one parent: each listener takes the transform that came last.
            self._foreign_frames = self._foreign_frames | (
                names & {frame.lstrip('/') for frame in heard}
            )

    def _on_observations(self, message: Any) -> None:
        observations = checked_observations(message, self._setup.frames.camera_frame)
        if observations.refusal == 'bad_observations':
            self.get_logger().warning(f'observations refused: {observations.detail}')
        self._state.add(observations)
        self._status_is_due.set()

    def _log_trouble(self, trouble: str) -> None:
        if trouble:
            self.get_logger().error(f'state not saved, in memory only: {trouble}')
        else:
            self.get_logger().info('state saved again')

    def _save_again(self) -> None:
        if self._state.is_unsaved:
            self._state.save()
            self._status_is_due.set()

    def _publish_status(self) -> None:
        if not (self.is_active and self._status_is_due.is_set()):
            return
        self._status_is_due.clear()  # first: a change during the rest leads to one more status
        message = status_to_message(
            self._state.status(), self._setup.frames.camera_frame, node.make_message
        )
        with self._publishing:
            if self.is_active:
                self._status.publish(message)

    def _on_calibrate(self, _request: Any, response: Any) -> Any:
        answer = self._with_silence(self._note_gate(self._state.solve()))
        return self._publish_and_answer(answer, response)

    def _on_solve(self, request: Any, response: Any) -> Any:
        answer = self._note_gate(
            self._state.solve(
                request.method, tuple(request.estimate), request.dry_run, request.force
            )
        )
        if answer.calibration is not None:
            response.calibration = calibration_to_message(answer.calibration, node.make_message)
        return self._publish_and_answer(self._with_silence(answer), response)

    def _on_reset(self, _request: Any, response: Any) -> Any:
        answer = self._state.reset()
        self._status_is_due.set()
        return self._publish_and_answer(answer, response)

    def _on_rollback(self, _request: Any, response: Any) -> Any:
        return self._publish_and_answer(self._note_gate(self._state.rollback()), response)

    def _on_lookup(self, request: Any, response: Any) -> Any:
        active = self._state.active
        points = request.points or _TABLE_POINTS
        response.success = False
        if not 2 <= points <= _MAX_TABLE_POINTS:
            response.message = f'points: {points} is not in the range 2 to {_MAX_TABLE_POINTS}'
        elif active is None:
            response.message = 'no calibration is active'
        else:
            camera = active.geometry.camera
            pixels = pixel_grid(camera, points, points)
            table = line_of_sight_table(camera, active.map_covariance, pixels)
            response.header = make_header(
                active.active_since_ns, active.child_frame, node.make_message
            )
            for name, column in table.columns().items():
                setattr(response, name, array.array('d', column.tobytes()))
            response.sigma_budget = [
                record_to_message(part, node.make_message) for part in active.sigma_budget
            ]
            response.success = True
            response.message = f'{len(pixels)} lines of sight of calibration {active.number}'
        return response

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _note_gate(self, answer: Answer) -> Answer:
        """Store the result of the gate for the diagnostics."""
        if answer.calibration is not None:
            reasons = '; '.join(answer.calibration.reasons)
            self._last_gate = 'accepted' if answer.calibration.accepted else f'refused: {reasons}'
        return answer

    def _publish_and_answer(self, answer: Answer, response: Any) -> Any:
        """Publish the active or the refused calibration; return the filled response."""
        if not self.is_active:
            pass  # deactivated meanwhile: activation publishes the active calibration
        elif answer.calibration is not None and answer.active:
            self._publish_active()
        elif answer.calibration is not None and not answer.success:
            self._candidate.publish(calibration_to_message(answer.calibration, node.make_message))
        self._last_answer = Answer(answer.success, answer.message)
        response.success, response.message = answer.success, answer.message
        return response

    def _publish_active(self) -> None:
        """Publish the active calibration, or that none is: an earlier one is withdrawn."""
        # Two requests may activate one each: of all publishers the last is of the later one.
        with self._publishing:
            calibration = self._state.active_on_disk
            if calibration is None:
                frames = self._setup.frames
                message, camera_info, alignment = none_active_to_messages(
                    self._setup.prior.camera,
                    (frames.star_tracker_frame, frames.camera_frame),
                    tuple(self._state.withheld.values()),
                    node.make_message,
                )
            else:
                message = calibration_to_message(calibration, node.make_message)
                camera_info = camera_info_to_message(calibration, node.make_message)
                alignment = alignment_to_message(calibration, node.make_message)
            self._camera_info.publish(camera_info)
            self._alignment.publish(alignment)
            self._calibration.publish(message)
            if calibration is None:
                return
            if self._tf_static is not None:
                transforms = [alignment, *mountings_to_messages(calibration, node.make_message)]
                self._own_transforms += transforms
                self._tf_static.publish(node.make_message(_TRANSFORMS, transforms=transforms))
            if self._driver is not None:
                self._driver.hand_over(camera_info)

    def _answered(self, answer: Any) -> Any:
        """Return the service callback wrapped so that errors are answered, logged and counted."""
        # The diagnostics may fail while the node is being deactivated; the answer must not.
        tell_health = self.guarded(self.publish_health_change)

        def run_and_tell(request: Any, response: Any) -> Any:
            if not self.is_active:
                state = self._state_machine.current_state[1]
                response.success, response.message = False, f'not active: {state}'
                return response
            try:
                response = answer(request, response)
            except Exception as error:
                self.count_error(error)
                response.success = False
                response.message = f'internal error: {type(error).__name__}: {error}'
                self._last_answer = Answer(False, response.message)
            self.get_logger().info(response.message)
            response.message = shortened(response.message, _MOST_CHARACTERS)
            tell_health()
            return response

        return run_and_tell


class CameraDriver:
    """
    Client of set_camera_info that reports the outcome of each call.

    A calibration is sent as soon as the service is available, and again to each server of it that
    appears: a driver that restarts has lost its camera.  After a refusal, or without an answer, it
    is sent again after a pause that doubles: the driver may be busy, or the request or its answer
    was lost before the two had discovered each other.  Safe to use from several threads.
    """

    def __init__(self, of_node: node.StarcalNode, service: str) -> None:
        self.failures = 0
        self.outcome = 'no calibration'
        self.has_failed = False  # last attempt
        self._node, self._service = of_node, service
        self._camera_info: Any = None
        self._is_there = False
        self._servers: frozenset[bytes] = frozenset()
        self._call: Any = None
        self._since_s = 0.0  # monotonic clock: the last request, or the last that was due
        self._pause_s = _TIMEOUT_S
        self._next_s = math.inf  # time of the next request; infinite: once the service appears
        self._closed = False
        self._lock = threading.RLock()
        group = ReentrantCallbackGroup()
        self._client = of_node.create_client(SetCameraInfo, service, callback_group=group)
        self._answers = f'rr{of_node.resolve_service_name(service)}Reply'  # its DDS topic
        self._timer = of_node.steady_timer(_LOOK_S, of_node.guarded(self._look), group)

    def close(self) -> None:
        """Destroy the client."""
        with self._lock:
            self._closed = True
            self._drop_call()
        self._node.destroy_timer(self._timer)
        self._node.destroy_client(self._client)

    def hand_over(self, camera_info: Any) -> None:
        """Send a sensor_msgs/CameraInfo in place of any earlier one; does not wait."""
        with self._lock:
            self._camera_info = camera_info
            self._drop_call()
            self._since_s = self._next_s = time.monotonic()
            self._pause_s = _TIMEOUT_S
            self.outcome, self.has_failed = 'waiting for the service', False
            self._look()

    def _look(self) -> None:
        with self._lock:
            if self._closed:
                return
            now_s = time.monotonic()
            is_due, is_overdue = now_s >= self._next_s, now_s > self._since_s + _TIMEOUT_S
            appeared = self._has_appeared() and self._camera_info is not None
            if appeared:
                self._pause_s = _TIMEOUT_S
            if self._is_there and (is_due or appeared):
                self._send(now_s)
            elif is_due and is_overdue:
                self._next_s = math.inf
                self._fail('service not available; will be sent when it is')
            elif self._call is not None and is_overdue:
                self._drop_call()
                self._fail(f'no answer within {_TIMEOUT_S:g} s')

    def _has_appeared(self) -> bool:
        """
        Return True if the service, or another server of it, has appeared since the last look.

        A driver restarts in less time than passes between two looks, and one that was killed
        counts as there until its lease ends, 20 s with Fast DDS.  Servers are known by the DDS
        topic of their answers; a middleware without DDS names leaves that empty.
        """
        was_there, self._is_there = self._is_there, self._client.service_is_ready()
        had = self._servers
        servers = self._node.get_publishers_info_by_topic(self._answers, no_mangle=True)
        self._servers = frozenset(bytes(server.endpoint_gid) for server in servers)
        return self._is_there and (not was_there or not self._servers <= had)

    def _send(self, now_s: float) -> None:
        self._drop_call()
        self._since_s, self._next_s = now_s, now_s + _TIMEOUT_S + self._pause_s
        self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self.outcome = 'waiting for its answer'
        self._call = self._client.call_async(SetCameraInfo.Request(camera_info=self._camera_info))
        self._call.add_done_callback(self._node.guarded(self._answered))

    def _answered(self, call: Any) -> None:
        with self._lock:
            if call is not self._call or self._closed:
                return  # the request was for a calibration that is no longer active
            self._call = None
            if call.exception() is not None:
                self._fail(f'failed: {call.exception()}')
            elif call.result().success:
                self.outcome, self.has_failed, self._next_s = 'accepted', False, math.inf
                self._node.get_logger().info(f'{self._service}: accepted')
            else:
                self._fail(f'refused: {" ".join(call.result().status_message.split())}')

    def _drop_call(self) -> None:
        if self._call is not None:
            self._client.remove_pending_request(self._call)
            self._call = None

    def _fail(self, outcome: str) -> None:
        self.outcome, self.has_failed = outcome, True
        self.failures += 1
        self._node.get_logger().error(f'{self._service}: {outcome}')


def main(args: Sequence[str] | None = None) -> int:
    """Run the calibrator until shutdown; exit status 2 for bad parameters."""
    return node.run(Calibrator, NAME, args)


if __name__ == '__main__':
    sys.exit(main())
