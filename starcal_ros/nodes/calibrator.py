"""The calibrator: star observations in, calibrations out."""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import sys
import threading
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import Trigger

from starcal.msg import Calibration as CalibrationMessage
from starcal.msg import EnsembleStatus as StatusMessage
from starcal.msg import StarObservations as ObservationsMessage
from starcal.srv import Calibrate
from starcal_ros import messages, pipeline
from starcal_ros.errors import StarcalError
from starcal_ros.node_options import CalibratorOptions
from starcal_ros.nodes.conversions import make_message, message_class
from starcal_ros.nodes.lifecycle import Health, OK, run, StarcalNode, WARN
from starcal_ros.options import from_mapping
from starcal_ros.records import Calibration, Ensemble

NAME = 'calibrator'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# A solve of minutes on a slow processor, at an image a second, loses none.
_OBSERVATIONS = QoSProfile(depth=1000)


class Calibrator(StarcalNode):
    """
    Collects observations and solves on request, in a thread of its own.

    The ensemble is a frozen record: a solve works on the one it began with while the next grows.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._made: list[tuple[Any, Any]] = []
        self._lock = threading.Lock()  # of the records below; never held during a solve
        self._ensemble = Ensemble()
        self._in_force: Calibration | None = None
        self._before: tuple[Calibration, ...] = ()
        self._last_answer = ''
        self._last_failed = False

    def configure(self) -> None:
        """Load prior camera and options, make the latched publishers."""
        values = self.options.values()
        self._own = from_mapping(CalibratorOptions, values)
        self._setup = pipeline.load_setup(values, self.options.classes)

        def latched(kind: Any, topic: str) -> Any:
            publisher = self.create_lifecycle_publisher(kind, topic, LATCHED)
            self._made.append((self.destroy_lifecycle_publisher, publisher))
            return publisher

        self._camera_info = latched(CameraInfo, 'camera_info')
        self._alignment = latched(TransformStamped, 'alignment')
        self._calibration = latched(CalibrationMessage, 'calibration')
        self._status = latched(StatusMessage, 'ensemble_status')
        try:
            self._tf_static = latched(message_class('tf2_msgs/msg/TFMessage'), '/tf_static')
        except ImportError:
            self._tf_static = None
        self._camera_client = None
        if self._own.set_camera_info_service:
            self._camera_client = self.create_client(
                SetCameraInfo, self._own.set_camera_info_service
            )
            self._made.append((self.destroy_client, self._camera_client))

    def activate(self) -> None:
        """Start to collect and to answer."""
        self._listeners: list[tuple[Any, Any]] = []
        collecting, solving = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        deciding = MutuallyExclusiveCallbackGroup()
        listener = self.create_subscription(
            ObservationsMessage,
            'observations',
            self.guarded(self._on_observations),
            _OBSERVATIONS,
            callback_group=collecting,
        )
        self._listeners.append((self.destroy_subscription, listener))
        for kind, name, answer, group in (
            (Trigger, '~/calibrate', self._on_calibrate, solving),
            (Calibrate, '~/solve', self._on_solve, solving),
            (Trigger, '~/reset', self._on_reset, deciding),
            (Trigger, '~/rollback', self._on_rollback, deciding),
        ):
            service = self.create_service(kind, name, self._answered(answer), callback_group=group)
            self._listeners.append((self.destroy_service, service))
        # In a thread of its own, and once for a burst: the newest status stands for all.
        self._status_due = self.create_guard_condition(
            self.guarded(self._publish_status), callback_group=MutuallyExclusiveCallbackGroup()
        )
        self._listeners.append((self.destroy_guard_condition, self._status_due))
        self._status_due.trigger()
        if self._in_force is not None:
            self._publish_calibration(self._in_force)

    def deactivate(self) -> None:
        """Stop collecting and answering."""
        listeners = getattr(self, '_listeners', [])
        while listeners:
            destroy, entity = listeners.pop()
            destroy(entity)

    def cleanup(self) -> None:
        """Let go of the publishers; the ensemble and the calibrations stay."""
        while self._made:
            destroy, entity = self._made.pop()
            destroy(entity)

    def health(self) -> Health:
        """What is collected, what is in force, and what came of the last request."""
        with self._lock:
            ensemble, in_force = self._ensemble, self._in_force
            numbers: dict[str, object] = {
                'images': len(ensemble.images),
                'stars': ensemble.star_count,
                **{f'refused_{reason}': n for reason, n in sorted(ensemble.refused.items())},
                'in_force': 'none' if in_force is None else in_force.time_ns,
                'last_answer': self._last_answer,
            }
            if self._last_failed:
                return WARN, self._last_answer, numbers
            return OK, 'collecting' if in_force is None else 'calibration in force', numbers

    def _on_observations(self, message: Any) -> None:
        observations = messages.observations_from_message(message)
        with self._lock:
            ensemble = self._ensemble
        grown = pipeline.add_to_ensemble(ensemble, observations, self._setup)
        with self._lock:
            if self._ensemble is not ensemble:  # emptied meanwhile: it starts with this image
                grown = Ensemble().add(observations)
            self._ensemble = grown
        self._status_due.trigger()

    def _publish_status(self) -> None:
        with self._lock:
            ensemble = self._ensemble
        status = pipeline.ensemble_status(ensemble, self._setup)
        frame_id = self._setup.frames.camera_frame
        self._status.publish(messages.status_to_message(status, frame_id, make_message))

    def _on_calibrate(self, _request: Any, response: Any) -> Any:
        response.success, response.message, _ = self._solve()
        return response

    def _on_solve(self, request: Any, response: Any) -> Any:
        response.success, response.message, calibration = self._solve(
            request.method, tuple(request.estimate), request.dry_run, request.force
        )
        if calibration is not None:
            response.calibration = messages.calibration_to_message(calibration, make_message)
        return response

    def _on_reset(self, _request: Any, response: Any) -> Any:
        with self._lock:
            images = len(self._ensemble.images)
            self._ensemble = Ensemble()
        self._status_due.trigger()
        response.success = True
        response.message = f'{images} images dropped; the calibration in force stays'
        return response

    def _on_rollback(self, _request: Any, response: Any) -> Any:
        with self._lock:
            if not self._before:
                response.message = 'there is no calibration before the one in force'
                if self._in_force is None:
                    response.message = 'no calibration is in force'
                return response
            self._in_force, self._before = self._before[-1], self._before[:-1]
            calibration = self._in_force
        self._publish_calibration(calibration)
        response.success = True
        response.message = f'back in force: {_summary(calibration)}'
        return response

    def _solve(
        self,
        method: str = '',
        estimate: tuple[str, ...] = (),
        dry_run: bool = False,
        force: bool = False,
    ) -> tuple[bool, str, Calibration | None]:
        """Whether a new calibration is (or would be) in force, why, and the solution."""
        with self._lock:
            ensemble = self._ensemble
        try:
            calibration = pipeline.solve(ensemble, self._setup, method, estimate)
        except StarcalError as error:
            return False, str(error), None
        if not calibration.accepted and not force:
            return False, 'refused by the gate: ' + '; '.join(calibration.reasons), calibration
        if not calibration.accepted:
            reasons = (*calibration.reasons, 'put in force by request all the same')
            calibration = dataclasses.replace(calibration, reasons=reasons)
        if dry_run:
            return True, f'would be in force: {_summary(calibration)}', calibration
        with self._lock:
            if self._in_force is not None:
                self._before = (*self._before, self._in_force)
            self._in_force = calibration
        self._publish_calibration(calibration)
        return True, f'in force: {_summary(calibration)}', calibration

    def _publish_calibration(self, calibration: Calibration) -> None:
        camera_info = messages.camera_info_to_message(calibration, make_message)
        alignment = messages.alignment_to_message(calibration, make_message)
        self._camera_info.publish(camera_info)
        self._alignment.publish(alignment)
        self._calibration.publish(messages.calibration_to_message(calibration, make_message))
        if self._tf_static is not None:
            self._tf_static.publish(make_message('tf2_msgs/msg/TFMessage', transforms=[alignment]))
        if self._camera_client is not None:
            if self._camera_client.service_is_ready():
                self._camera_client.call_async(SetCameraInfo.Request(camera_info=camera_info))
            else:
                service = self._own.set_camera_info_service
                self.get_logger().warning(f'{service}: not there; the camera was not told')

    def _answered(self, answer: Any) -> Any:
        """Return the service callback with errors answered, logged and counted."""

        def run_and_tell(request: Any, response: Any) -> Any:
            try:
                response = answer(request, response)
            except Exception as error:
                self.count_error(error)
                response.success = False
                response.message = f'internal error: {type(error).__name__}: {error}'
            with self._lock:
                self._last_answer, self._last_failed = response.message, not response.success
            self.get_logger().info(response.message)
            self.publish_health_change()
            return response

        return run_and_tell


def _summary(calibration: Calibration) -> str:
    return (
        f'{calibration.residual_rms_px:.3f} px rms per axis over {calibration.stars_used} stars'
        f' in {calibration.images_used} images'
    )


def main(args: Sequence[str] | None = None) -> int:
    """Run the calibrator until it is told to end; exit status 2 for bad parameters."""
    return run(Calibrator, NAME, args)


if __name__ == '__main__':
    sys.exit(main())
