# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observer node: subscribes to images and attitudes, publishes star observations."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
import dataclasses
import functools
import math
import operator
import sys
import threading
import time
from typing import Any

from geometry_msgs.msg import PoseStamped, QuaternionStamped, TransformStamped, TwistStamped
import numpy as np
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Imu, Temperature
from sensor_msgs.msg import Image as ImageMessage

from starcal.msg import Calibration as CalibrationMessage
from starcal.msg import StarObservations as ObservationsMessage
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused, OptionError
from starcal_ros.formats.messages import message_codec, record_messages, sensor_messages
from starcal_ros.options import from_mapping
from starcal_ros.pipeline import annotation, observe, setup
from starcal_ros.records import CameraGeometry, Image, IMAGE_REFUSALS, StarObservations
from starcal_ros.ros.image_queue import ImageQueue, Recent, StarTrackers, Waiting
from starcal_ros.ros.inputs import LATCHED
from starcal_ros.ros.node import Health, make_message, OK, run, StarcalNode, WARN
from starcal_ros.sky.attitude import attitude_sample
from starcal_ros.sky.velocity import doubt_of
from starcal_ros.text import counted
from starcal_ros.untrusted import shown

NAME = 'star_observer'
_ATTITUDES = (QuaternionStamped, PoseStamped, TransformStamped, Imu)
_IMAGE_TYPES = (ImageMessage, CompressedImage)
_IMAGES = 20  # images that wait with their pixels: 200 MB at 5 megapixels and 16 bit
# Ten seconds of a fast star tracker; a bag played fast sends bursts.
_SAMPLES = QoSProfile(depth=2000)
_COMPARED = 8  # velocities with that of the Earth: 1 ms, once a second
_STAMP_NS = operator.itemgetter(0)
_DISCOVERY_S = 5.0  # an announcement that is lost on a busy machine is repeated after 3 s
_MOST_UNDISCOVERED = 3 * _IMAGES // 4  # waiting images: the others are room for the next
# Attitudes of an hour take 2 MB at 10 Hz, and up to two hours are held; only a recorder sends
# later images.
_HISTORY_S = 3600.0
_KEPT = 5  # images that matched nothing: 50 MB of 5 megapixels and 16 bit
_JUMP_S = 10.0  # smaller steps back are late messages, not a clock change


class StarObserver(StarcalNode):
    """
    Measures the stars of every image, in order of arrival, in a worker thread.

    Callbacks only store their messages; the worker thread alone changes the prediction.
    """

    # By `activate`, before the callbacks that use them.
    _queue: ImageQueue

    def __init__(self) -> None:
        super().__init__(NAME)
        self._worker: threading.Thread | None = None

    def configure(self) -> None:
        """Load the prior camera and the catalog, create the publishers."""
        values = self.options.values()
        self._own = from_mapping(setup.ObserverOptions, values)
        self._setup = setup.load_setup(values)
        setup.check_site(self._setup.site)
        if not self._setup.is_aligned:
            raise OptionError(
                'prior_alignment: not given: starcal calibrate BAG finds it from a recording,'
                ' setup_finder beside the camera'
            )
        self._geometry = self._setup.prior
        self._calibration_number = 0  # the calibration that predicts the stars; 0: the prior
        self._withdrawn = ''  # why the prior predicts the stars where a calibration did
        self._observations = self.publisher(
            ObservationsMessage, 'observations', QoSProfile(depth=100)
        )
        self._annotated = self.publisher(ImageMessage, 'annotated_image', QoSProfile(depth=2))
        self._camera_info: Any = None  # the latched one, header of the last image
        self._camera_infos = self.publisher(
            CameraInfo, 'image_camera_info', QoSProfile(depth=_IMAGES)
        )

    def activate(self) -> None:
        """Subscribe to images and attitudes, start the worker thread."""
        jump_s = max(_JUMP_S, self._setup.attitude.max_attitude_gap_s)
        self._star_trackers = StarTrackers(
            1 + len(self._setup.mountings),
            _HISTORY_S,
            jump_s,
            self._setup.attitude.max_attitude_gap_s,
            self._own.attitude_timeout_s,
        )
        # The last images that matched nothing, which a calibration may mend, or an attitude of the
        # star trackers that each still awaits.
        self._unmatched: tuple[tuple[Image, frozenset[int]], ...] = ()
        self._track = observe.Track(self._geometry)
        self._predicted_from = self._geometry
        self._velocities: deque[tuple[int, Any]] = deque(maxlen=_SAMPLES.depth)
        self._temperatures: deque[tuple[int, float]] = deque(maxlen=_SAMPLES.depth)
        self._counts: Counter[str] = Counter()
        self._restarts = self._retried = self._retried_used = 0
        self._last_refusal = self._bad_velocity = ''
        self._velocities_left_out, self._doubts_velocity = 0, False
        self._image_arrivals, self._latency_s, self._attitude_step_s = Recent(), Recent(), Recent()
        self._queue = ImageQueue(
            _IMAGES, self._own.attitude_timeout_s, self._star_trackers.has_come
        )
        self._worker = threading.Thread(target=self._measure_all, name='measure')
        self._worker.start()
        for kinds, topic, callback, qos, adapts in (
            ((CalibrationMessage,), 'calibration', self._on_calibration, LATCHED, False),
            ((TwistStamped,), 'velocity', self._on_velocity, _SAMPLES, True),
            ((Temperature,), 'temperature', self._on_temperature, _SAMPLES, True),
            (_ATTITUDES, 'attitude', self._on_attitude, _SAMPLES, True),
        ):
            self.inputs.add(kinds, topic, self.taking(callback), qos, adapts=adapts)
        for which, mounting in enumerate(self._setup.mountings, 1):
            callback = functools.partial(self._add_attitude, which)
            topic = f'{mounting.frame}/attitude'
            self.inputs.add(_ATTITUDES, topic, self.taking(callback), _SAMPLES, adapts=True)
        take, depth = self.taking(self._on_image), QoSProfile(depth=_IMAGES)
        self.inputs.add(_IMAGE_TYPES, 'image', take, depth, adapts=True, raw=True)

    def deactivate(self) -> None:
        """Close the inputs and drop the images in the queue."""
        self.inputs.close()
        if self._worker is None:
            return
        if len(self._queue):
            self.get_logger().warning(
                f'{counted(len(self._queue), "image")} dropped from the queue'
            )
        self._queue.close()
        self._worker.join()
        self._worker = None

    def health(self) -> Health:
        """Diagnostics: counts of used and refused images."""
        counts = dict(self._counts)  # the worker thread continues counting
        trackers, first = self._track.trackers, self._setup.frames.star_tracker_frame
        not_used = [
            f'{name or first}: {tracker.unfit}'
            for name, tracker in trackers.items()
            if tracker.unfit
        ]
        lost = self.inputs.lost().get(self.resolve_topic_name('image'), 0)
        numbers: dict[str, object] = {
            'images': sum(counts.values()),
            'images_used': counts.get('', 0),
            'images_waiting': len(self._queue),
            'images_lost': lost,
            'image_rate_hz': _short(self._image_arrivals.rate_hz()),
            'latency_median_s': _short(self._latency_s.median()),
            'latency_worst_s': _short(self._latency_s.largest()),
            'attitudes': len(self._star_trackers.histories[0]),
            'attitude_rate_hz': _short(self._attitude_step_s.rate_hz()),
            'attitude_gap_s': _short(self._attitude_step_s.largest()),
            'attitudes_not_used': ', '.join(not_used) or 'none',
            'velocities_left_out': self._velocities_left_out,
            'restarts': self._restarts,
            'retried': self._retried,
            'retried_used': self._retried_used,
            'calibration': self._calibration_number or 'prior',
            'listeners': self._observations.get_subscription_count(),
            **{f'refused_{reason}': counts.get(reason, 0) for reason in sorted(IMAGE_REFUSALS)},
        }
        if self._withdrawn:
            return WARN, self._withdrawn, numbers
        if self._last_refusal:
            return WARN, f'last image refused: {self._last_refusal}', numbers
        if why_not := [tracker.why_unfit for tracker in trackers.values() if tracker.why_unfit]:
            return WARN, '; '.join(why_not), numbers
        if bad_velocity := self._bad_velocity or self._doubt_of_velocity():
            return WARN, bad_velocity, numbers
        if lost:
            lost_images = f'{counted(lost, "image")} lost before they reached the node'
            return WARN, f'{lost_images}: give DDS larger buffers (config/fastdds.xml)', numbers
        if not counts:
            return OK, 'waiting for images', numbers
        return OK, 'observing', numbers

    def needed(self) -> list[str]:
        """Return the topics of the images and attitudes."""
        further = (f'{mounting.frame}/attitude' for mounting in self._setup.mountings)
        return [self.resolve_topic_name(topic) for topic in ('image', 'attitude', *further)]

    def _on_image(self, raw: message_codec.RawMessage) -> None:
        self._image_arrivals.add(0.0)
        try:
            message = sensor_messages.view_image(raw)
        except ImageRefused:
            self._in_worker(self._publish, sensor_messages.image_of(raw))
            return
        self._publish_camera_info(message)
        time_ns = message_codec.stamp_ns(message.header.stamp)
        time_ns += message_codec.offset_ns(self._setup.attitude.stamp_offset_s)
        width, height = getattr(message, 'width', 0), getattr(message, 'height', 0)
        self._queue.put(time_ns, width, height, raw)

    def _publish_camera_info(self, message: Any) -> None:
        """Publish the latched camera, once there is one, with the header of an image message."""
        camera_info = self._camera_info
        if camera_info is None:
            return
        # A compressed image has no size; an image of another size is from another camera.
        size = (camera_info.width, camera_info.height)
        if (getattr(message, 'width', size[0]), getattr(message, 'height', size[1])) == size:
            stamp = make_message('builtin_interfaces/msg/Time', **vars(message.header.stamp))
            camera_info.header.stamp, camera_info.header.frame_id = stamp, message.header.frame_id
            self._camera_infos.publish(camera_info)

    def _on_attitude(self, message: Any) -> None:
        history = self._star_trackers.histories[0]
        before_ns = history.latest_ns
        self._add_attitude(0, message)
        # Late samples and steps back of the clock are not gaps.
        latest_ns = history.latest_ns or 0
        step_ns = 0 if before_ns is None else max(0, latest_ns - before_ns)
        self._attitude_step_s.add(step_ns / NANOSECONDS_PER_SECOND)

    def _add_attitude(self, which: int, message: Any) -> None:
        time_ns, quaternion = sensor_messages.attitude_from_message(message)
        direction = self._setup.attitude.attitude_direction
        self._star_trackers.add(which, time_ns, attitude_sample(time_ns, quaternion, direction))
        if any(awaited for _, awaited in self._unmatched):
            self._in_worker(self._measure_awaiting)
        self._queue.wake()

    def _on_velocity(self, message: Any) -> None:
        try:
            self._velocities.append(sensor_messages.velocity_from_message(message))
            self._bad_velocity = ''
        except ValueError as error:
            self._bad_velocity = str(error)
            self._velocities_left_out += 1
            if self._velocities_left_out == 1:  # the diagnostics count the others
                self.get_logger().warning(self._bad_velocity)

    def _doubt_of_velocity(self) -> str:
        """Return the mistake that the velocities show, logged once; empty if they show none."""
        kept = [one for one in list(self._velocities) if one[0] >= 0]  # UTC begins in 1960
        if not kept or self._setup.site.observer == 'ground':
            return ''
        some = kept[:: -(-len(kept) // _COMPARED)]
        doubt = doubt_of([time_ns for time_ns, _ in some], np.array([one for _, one in some]))
        is_stated = self._setup.calibration.velocity_sigma_m_s >= 0
        if doubt is None or (is_stated and not doubt.is_certain):
            return ''
        text = f'the velocity {"is" if doubt.is_certain else "may be"} {doubt.mistake}'
        if not self._doubts_velocity:
            self._doubts_velocity = True
            self.get_logger().warning(text)
        return text

    def _on_temperature(self, message: Any) -> None:
        self._temperatures.append(sensor_messages.temperature_from_message(message))

    def _on_calibration(self, message: Any) -> None:
        calibration = record_messages.active_from_message(message)
        if calibration is None:
            self._withdraw(message)
            return
        if not (calibration.accepted or calibration.forced):
            raise ValueError('calibration: refused by the gate')
        geometry = calibration.geometry
        prior = self._setup.prior.camera
        if (geometry.camera.width, geometry.camera.height) != (prior.width, prior.height):
            raise ValueError('calibration: image size differs from the prior camera')
        named, frames = (calibration.child_frame, calibration.parent_frame), self._setup.frames
        if named != (own := (frames.camera_frame, frames.star_tracker_frame)):
            raise ValueError(f'calibration: frames {shown(named)}, not {own}')
        self._camera_info = record_messages.camera_info_to_message(calibration, make_message)
        self._withdrawn = ''
        self._in_worker(self._predict_with, geometry, calibration.number)

    def _withdraw(self, message: Any) -> None:
        """Predict with the prior, and send a camera that is not calibrated with each image."""
        was_calibrated = self._camera_info is not None and self._camera_info.k[0] != 0
        if reasons := record_messages.why_none_is_active(message):
            self._withdrawn = f'no calibration is active, the prior predicts the stars: {reasons}'
        elif was_calibrated:
            self._withdrawn = 'the calibration was withdrawn, the prior predicts the stars'
        frames = self._setup.frames
        _, self._camera_info, _ = record_messages.none_active_to_messages(
            self._setup.prior.camera,
            (frames.star_tracker_frame, frames.camera_frame),
            (),
            make_message,
        )
        if was_calibrated:
            self._in_worker(self._predict_with, None, 0)

    def _predict_with(self, geometry: CameraGeometry | None, number: int) -> None:
        """Predict with a calibration; None: with the prior."""
        self._geometry, self._calibration_number = geometry or self._setup.prior, number
        if self._withdrawn:
            self.get_logger().warning(self._withdrawn)
        else:
            self.get_logger().info('predicting stars with the active calibration')
        self._measure_again()

    def _in_worker(self, function: Callable[..., None], *arguments: Any) -> None:
        self._queue.call(functools.partial(self.guarded(function), *arguments))

    def _measure_all(self) -> None:
        is_first = True
        while (waiting := self._queue.take()) is not None:
            if is_first:
                self._await_discovery()
                is_first = False
            try:
                self._measure(waiting)
            except Exception as error:
                self.count_error(error)
                if not self.context.ok():
                    return  # shutdown: no refusal can be published
                detail = f'{type(error).__name__}: {error}'
                self._publish(waiting.refused('internal_error', detail))
            self._latency_s.add(time.monotonic() - waiting.arrived_s)
            self.guarded(self.publish_health_change)()

    def _await_discovery(self) -> None:
        """
        Wait until the others are discovered, or images would be lost.

        Where all nodes start at once, the first image may be faster than the discovery of the
        calibrator, and its observations would reach nobody; or than the velocity, which would then
        be an unknown of the calibration.
        """
        until_s = time.monotonic() + _DISCOVERY_S
        while not (self._is_heard() and self._is_told()) and time.monotonic() < until_s:
            if self._queue.is_closed or len(self._queue) >= _MOST_UNDISCOVERED:
                return
            time.sleep(0.02)  # rclpy cannot wait for a match

    def _is_heard(self) -> bool:
        """Return True if each subscriber that the graph shows is matched, and there is one."""
        known = self.count_subscribers(self._observations.topic_name)
        return bool(known) and self._observations.get_subscription_count() >= known

    def _is_told(self) -> bool:
        """Return True if velocity and temperature have come, where the graph has a publisher."""
        return all(
            self.taken(callback) or not self.count_publishers(self.resolve_topic_name(topic))
            for topic, callback in (
                ('velocity', self._on_velocity),
                ('temperature', self._on_temperature),
            )
        )

    def _measure(self, waiting: Waiting) -> None:
        if waiting.message is None:
            detail = f'{_IMAGES} images were in the queue'
            self._publish(waiting.refused('overrun', detail))
            return
        offset_s, camera = self._setup.attitude.stamp_offset_s, self._setup.prior.camera
        size, channel = (camera.width, camera.height), self._setup.frames.image_channel
        image = sensor_messages.image_of(waiting.message, offset_s, size, channel)
        if isinstance(image, StarObservations):
            self._publish(image)
            return
        if self._geometry is not self._predicted_from:
            self._predicted_from = self._geometry
            self._track = dataclasses.replace(self._track, geometry=self._geometry)
        before = self._track
        # Asked first: an attitude that comes during the measurement was awaited.
        awaited = self._star_trackers.awaited(image.time_ns)
        observations, self._track = self._observe_next(image, before)
        if before.behind and not self._track.behind and image.time_ns <= (before.latest_ns or 0):
            self._restarts += 1
            self.get_logger().warning('image stamps went back: restarted the sequence')
        self._publish(observations)
        if observations.refusal == 'no_match':
            self._unmatched = (*self._unmatched, (image, awaited))[-_KEPT:]
            self._measure_awaiting()
        if self._annotated.get_subscription_count():
            self._publish_annotated(image, observations, before.geometry)

    def _observe_next(
        self, image: Image, track: observe.Track
    ) -> tuple[StarObservations, observe.Track]:
        first, *more = self._star_trackers.histories
        return observe.observe_next(
            image,
            first,
            self._setup,
            track,
            sensor_messages.latest_at(
                sorted(self._velocities, key=_STAMP_NS), image.time_ns, None
            ),
            sensor_messages.latest_at(
                sorted(self._temperatures, key=_STAMP_NS), image.time_ns, math.nan
            ),
            more,
        )

    def _measure_again(self) -> None:
        """Measure the images that matched nothing with the calibration that became active."""
        self._retry([image for image, _ in self._unmatched])
        self._unmatched = ()

    def _measure_awaiting(self) -> None:
        """Measure the images that matched nothing and whose awaited attitude has come."""
        still = [
            (image, awaited & self._star_trackers.awaited(image.time_ns), awaited)
            for image, awaited in self._unmatched
        ]
        used_ns = self._retry([image for image, now, before in still if now != before])
        # The others are kept for a calibration.
        self._unmatched = tuple(
            (image, now) for image, now, _ in still if image.time_ns not in used_ns
        )

    def _retry(self, images: Sequence[Image]) -> set[int]:
        """Measure images again that matched nothing; return the stamps of those that are used."""
        used = set()
        for image in images:
            observations, _ = self._observe_next(image, observe.Track(self._geometry))
            self._retried += 1
            if not observations.refusal:
                used.add(image.time_ns)
                self._retried_used += 1
                self._counts['no_match'] -= 1
                self._publish(observations)
        if images:
            self.get_logger().info(
                f'{counted(len(images), "image")} without a match measured again: {len(used)} used'
            )
        return used

    def _publish(self, observations: StarObservations) -> None:
        frame_id = self._setup.frames.camera_frame
        self._observations.publish(
            record_messages.observations_to_message(observations, frame_id, make_message)
        )
        self._counts[observations.refusal] += 1
        self._last_refusal = (
            observations.refusal and f'{observations.refusal}: {observations.detail}'
        )
        text = (self._last_refusal and f'refused: {self._last_refusal}') or observations.detail
        if text:
            seconds = observations.time_ns / NANOSECONDS_PER_SECOND
            self.get_logger().warning(f'image at {seconds:.3f} s: {text}')
        else:
            self.get_logger().debug(counted(len(observations), 'star'))

    def _publish_annotated(
        self, image: Image, observations: StarObservations, geometry: CameraGeometry
    ) -> None:
        picture = annotation.annotate(image, observations, geometry)
        frame_id = self._setup.frames.camera_frame
        self._annotated.publish(
            sensor_messages.image_to_message(image.time_ns, picture, frame_id, make_message)
        )


def _short(number: float | None) -> str:
    return 'none' if number is None else f'{number:.3f}'


def main(args: Sequence[str] | None = None) -> int:
    """Run the star observer until shutdown; exit status 2 for bad parameters."""
    return run(StarObserver, NAME, args)


if __name__ == '__main__':
    sys.exit(main())
