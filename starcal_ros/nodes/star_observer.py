"""Star observer node: subscribes to images and attitudes, publishes star observations."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
import dataclasses
import math
import sys
import threading
import time
from typing import Any

from geometry_msgs.msg import PoseStamped, QuaternionStamped, TransformStamped, TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu, Temperature
from sensor_msgs.msg import Image as ImageMessage

from starcal.msg import Calibration as CalibrationMessage
from starcal.msg import StarObservations as ObservationsMessage
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.messages.calibration import calibration_from_message, camera_info_to_message
from starcal_ros.messages.fields import offset_ns, stamp_ns
from starcal_ros.messages.images import color_image_to_message, image_from_message
from starcal_ros.messages.observations import observations_to_message
from starcal_ros.messages.telemetry import (
    attitude_from_message,
    temperature_from_message,
    velocity_from_message,
)
from starcal_ros.nodes.image_queue import ImageQueue, Waiting
from starcal_ros.nodes.inputs import with_reliability
from starcal_ros.nodes.lifecycle import Health, OK, run, StarcalNode, WARN
from starcal_ros.nodes.message_factory import make_message
from starcal_ros.nodes.sliding_window import Recent
from starcal_ros.options import from_mapping
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.node_options import ObserverOptions
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import (
    CameraGeometry,
    Image,
    IMAGE_REFUSALS,
    refused_image,
    StarObservations,
)
from starcal_ros.report.annotation import annotate
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory

NAME = 'star_observer'
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Ten seconds of a fast star tracker; a bag played fast sends bursts.
# Values of the option `attitude_message`.
_ATTITUDE_MESSAGES = {
    'quaternion': QuaternionStamped,
    'pose': PoseStamped,
    'transform': TransformStamped,
    'imu': Imu,
}
_SAMPLES = QoSProfile(depth=2000)
_MAX_VELOCITY_M_S = 1e6
_JUMP_S = 10.0  # smaller steps back are late messages, not a clock change


class StarObserver(StarcalNode):
    """
    Measures the stars of every image, in order of arrival, in a worker thread.

    Callbacks only store their messages; the worker thread alone changes the prediction.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._publishers_made: list[Any] = []
        self._worker: threading.Thread | None = None
        self._queue: ImageQueue | None = None
        self._counts: Counter[str] = Counter()
        self._last_refusal = ''
        self._camera_info: Any = None  # of the active calibration, header of the last image
        self._camera_infos: Any = None

    def configure(self) -> None:
        """Load the prior camera and the catalog, create the publishers."""
        values = self.options.values()
        self._own = from_mapping(ObserverOptions, values)
        self._setup = load_setup(values, self.options.classes)
        self._geometry = self._setup.prior
        self._calibration_number = 0  # of the calibration used for prediction; 0: the prior
        self._observations = self.create_lifecycle_publisher(
            ObservationsMessage, 'observations', QoSProfile(depth=100)
        )
        self._annotated = self.create_lifecycle_publisher(
            ImageMessage, 'annotated_image', QoSProfile(depth=2)
        )
        self._publishers_made = [self._observations, self._annotated]
        self._camera_info = self._camera_infos = None
        if self._own.camera_info_per_image:
            self._camera_infos = self.create_lifecycle_publisher(
                CameraInfo, 'image_camera_info', QoSProfile(depth=self._own.image_queue)
            )
            self._publishers_made.append(self._camera_infos)

    def activate(self) -> None:
        """Subscribe to images and attitudes, start the worker thread."""
        jump_s = max(_JUMP_S, self._setup.attitude.max_attitude_gap_s)
        self._attitudes = AttitudeHistory(self._own.attitude_history_s, jump_s)
        self._track = observe.Track(self._geometry)
        self._predicted_from = self._geometry
        self._velocities: deque[tuple[int, Any]] = deque(maxlen=_SAMPLES.depth)
        self._temperatures: deque[tuple[int, float]] = deque(maxlen=_SAMPLES.depth)
        self._counts.clear()
        self._restarts = 0
        self._last_refusal = ''
        self._image_arrivals, self._latency_s, self._attitude_step_s = Recent(), Recent(), Recent()
        self._queue = ImageQueue(
            self._own.image_queue, self._own.attitude_timeout_s, self._attitude_has_come
        )
        self._worker = threading.Thread(target=self._measure_all, name='measure')
        self._worker.start()
        asked = self._own.image_reliability
        attitude_message = _ATTITUDE_MESSAGES[self._setup.attitude.attitude_message]
        images = with_reliability(
            QoSProfile(depth=self._own.image_queue),
            ReliabilityPolicy.BEST_EFFORT
            if asked == 'best_effort'
            else ReliabilityPolicy.RELIABLE,
        )
        for kind, topic, callback, qos, adapts in (
            (CalibrationMessage, 'calibration', self._on_calibration, LATCHED, False),
            (TwistStamped, 'velocity', self._on_velocity, _SAMPLES, True),
            (Temperature, 'temperature', self._on_temperature, _SAMPLES, True),
            (attitude_message, 'attitude', self._on_attitude, _SAMPLES, True),
            (*self._image_input(), self._on_image, images, asked == 'auto'),
        ):
            self.inputs.add(kind, topic, self.taking(callback), qos, adapts=adapts)

    def _image_input(self) -> tuple[Any, str]:
        if self._own.image_transport == 'raw':
            return ImageMessage, 'image'
        # Name as in image_transport, so that a remap of `image` applies.
        return CompressedImage, self.resolve_topic_name('image') + '/compressed'

    def deactivate(self) -> None:
        """Stop listening; what still waits in the queue is let go."""
        self.inputs.close()
        if self._queue is not None and self._worker is not None:
            if len(self._queue):
                self.get_logger().warning(f'{len(self._queue)} images dropped from the queue')
            self._queue.close()
            self._worker.join()
        self._worker = None

    def cleanup(self) -> None:
        """Destroy the publishers."""
        while self._publishers_made:
            self.destroy_lifecycle_publisher(self._publishers_made.pop())

    def health(self) -> Health:
        """Diagnostics: counts of used and refused images."""
        counts = dict(self._counts)  # the worker thread continues counting
        numbers: dict[str, object] = {
            'images': sum(counts.values()),
            'images_used': counts.get('', 0),
            'images_waiting': len(self._queue or ()),
            'image_rate_hz': _short(self._image_arrivals.rate_hz()),
            'latency_median_s': _short(self._latency_s.median()),
            'latency_worst_s': _short(self._latency_s.largest()),
            'attitudes': len(self._attitudes),
            'attitude_rate_hz': _short(self._attitude_step_s.rate_hz()),
            'attitude_gap_s': _short(self._attitude_step_s.largest()),
            'restarts': self._restarts,
            'calibration': self._calibration_number or 'prior',
            'listeners': self._observations.get_subscription_count(),
            **{f'refused_{reason}': counts.get(reason, 0) for reason in sorted(IMAGE_REFUSALS)},
        }
        if self._last_refusal:
            return WARN, f'last image refused: {self._last_refusal}', numbers
        if not counts:
            return OK, 'waiting for images', numbers
        return OK, 'observing', numbers

    def _on_image(self, message: Any) -> None:
        self._image_arrivals.add(0.0)
        self._publish_camera_info(message)
        time_ns = stamp_ns(message.header.stamp)
        time_ns += offset_ns(self._setup.attitude.stamp_offset_s)
        if self._queue is not None:
            width, height = getattr(message, 'width', 0), getattr(message, 'height', 0)
            self._queue.put(time_ns, width, height, message)

    def _publish_camera_info(self, message: Any) -> None:
        """Publish the active calibration with the header of an image message."""
        camera_info = self._camera_info
        if camera_info is None or self._camera_infos is None:
            return
        # A compressed image has no size; an image of another size is from another camera.
        size = (camera_info.width, camera_info.height)
        if (getattr(message, 'width', size[0]), getattr(message, 'height', size[1])) == size:
            camera_info.header = message.header
            self._camera_infos.publish(camera_info)

    def _on_attitude(self, message: Any) -> None:
        time_ns, quaternion = attitude_from_message(message)
        direction = self._setup.attitude.attitude_direction
        before_ns = self._attitudes.latest_ns
        self._attitudes.add(time_ns, attitude_sample(time_ns, quaternion, direction))
        # Late samples and steps back of the clock are not gaps.
        latest_ns = self._attitudes.latest_ns or 0
        step_ns = 0 if before_ns is None else max(0, latest_ns - before_ns)
        self._attitude_step_s.add(step_ns / NANOSECONDS_PER_SECOND)
        if self._queue is not None:
            self._queue.wake()

    def _on_velocity(self, message: Any) -> None:
        time_ns, velocity_m_s = velocity_from_message(message)
        # The Earth moves at 3e4 m/s; a value beyond this limit would displace all stars.
        if not float(abs(velocity_m_s).max()) < _MAX_VELOCITY_M_S:
            raise ValueError(
                f'velocity: {velocity_m_s.tolist()} m/s is not plausible for a spacecraft'
            )
        self._velocities.append((time_ns, velocity_m_s))

    def _on_temperature(self, message: Any) -> None:
        self._temperatures.append(temperature_from_message(message))

    def _on_calibration(self, message: Any) -> None:
        calibration = calibration_from_message(message)
        if not (calibration.accepted or calibration.forced):
            raise ValueError('calibration: refused by the gate')
        geometry = calibration.geometry
        prior = self._setup.prior.camera
        if (geometry.camera.width, geometry.camera.height) != (prior.width, prior.height):
            raise ValueError('calibration: image size differs from the prior camera')
        self._geometry, self._calibration_number = geometry, calibration.number
        if self._camera_infos is not None:
            self._camera_info = camera_info_to_message(calibration, make_message)
        self.get_logger().info('predicting stars with the active calibration')

    def _attitude_has_come(self, time_ns: int) -> bool:
        """Return True if the attitude samples of an image have arrived or can no longer arrive."""
        latest_ns = self._attitudes.latest_ns
        if latest_ns is None or latest_ns < time_ns:
            return False
        gap_s = self._setup.attitude.max_attitude_gap_s
        if latest_ns > time_ns + offset_ns(gap_s):
            return True
        try:
            self._attitudes.at(time_ns, gap_s)
        except ImageRefused:
            return False
        return True

    def _measure_all(self) -> None:
        assert self._queue is not None  # created before the thread
        while (waiting := self._queue.take()) is not None:
            try:
                self._measure(waiting)
            except Exception as error:
                self.count_error(error)
                if not self.context.ok():
                    return  # shutdown: no refusal can be published
                detail = f'{type(error).__name__}: {error}'
                self._publish(self._refused(waiting, 'internal_error', detail))
            self._latency_s.add(time.monotonic() - waiting.arrived_s)
            self.guarded(self.publish_health_change)()

    def _measure(self, waiting: Waiting) -> None:
        if waiting.message is None:
            detail = f'{self._own.image_queue} images were in the queue'
            self._publish(self._refused(waiting, 'overrun', detail))
            return
        try:
            image = image_from_message(
                waiting.message,
                self._setup.attitude.stamp_offset_s,
                self._setup.frames.image_channel,
            )
        except ImageRefused as refused:
            self._publish(self._refused(waiting, refused.reason, refused.detail))
            return
        if self._geometry is not self._predicted_from:
            self._predicted_from = self._geometry
            self._track = dataclasses.replace(self._track, geometry=self._geometry)
        before = self._track
        observations, self._track = observe.observe_next(
            image,
            self._attitudes,
            self._setup,
            before,
            observe.latest_at(list(self._velocities), image.time_ns, None),
            observe.latest_at(list(self._temperatures), image.time_ns, math.nan),
        )
        if before.behind and not self._track.behind and image.time_ns <= (before.latest_ns or 0):
            self._restarts += 1
            self.get_logger().warning('image stamps went back: restarted the sequence')
        self._publish(observations)
        if self._annotated.get_subscription_count():
            self._publish_annotated(image, observations, before.geometry)

    def _refused(self, waiting: Waiting, reason: str, detail: str) -> StarObservations:
        return refused_image(waiting.time_ns, waiting.width, waiting.height, reason, detail)

    def _publish(self, observations: StarObservations) -> None:
        frame_id = self._setup.frames.camera_frame
        self._observations.publish(observations_to_message(observations, frame_id, make_message))
        self._counts[observations.refusal] += 1
        self._last_refusal = (
            observations.refusal and f'{observations.refusal}: {observations.detail}'
        )
        if observations.refusal:
            seconds = observations.time_ns / NANOSECONDS_PER_SECOND
            self.get_logger().warning(f'image at {seconds:.3f} s refused: {self._last_refusal}')
        else:
            self.get_logger().debug(f'{len(observations)} stars')

    def _publish_annotated(
        self, image: Image, observations: StarObservations, geometry: CameraGeometry
    ) -> None:
        picture = annotate(image, observations, geometry)
        frame_id = self._setup.frames.camera_frame
        self._annotated.publish(
            color_image_to_message(image.time_ns, picture, frame_id, make_message)
        )


def _short(number: float | None) -> str:
    return 'none' if number is None else f'{number:.3f}'


def main(args: Sequence[str] | None = None) -> int:
    """Run the star observer until shutdown; exit status 2 for bad parameters."""
    return run(StarObserver, NAME, args)


if __name__ == '__main__':
    sys.exit(main())
