# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images through both nodes while nodes are killed, with checks of all published messages."""

from collections import Counter
from pathlib import Path
import time
from typing import Any

from geometry_msgs.msg import QuaternionStamped
import numpy as np
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
from vehicle import BOTH, Client, NodeProcess, Vehicle  # type: ignore[import-not-found]

from bench.frames import history, render_frame, write_set_up
from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ground.bag_writer import attitude_to_message, image_to_message
from starcal_ground.parameter_files import read_parameter_file
from starcal_ground.simulation.scenario import scenario
from starcal_ros.formats.messages.message_codec import make_header, stamp_ns
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.ros.node import make_message

_FIRST_NS = 1_778_829_600_000_000_000
_STEP_NS = 1_000_000_000
_AROUND_NS = (-200_000_000, -20_000_000, 20_000_000, 200_000_000)
_IN_FLIGHT = 4
_ANSWER_S = 120.0
# Centroids depend on the prediction by much less than their noise of 0.05 px.
_SAME_PX = 0.5


class Flight:
    """
    Both nodes with ten small frames and requests in flight, whose answers are checked.

    A calibrator has after a restart each image that it reported as saved. A running star observer
    answers each image that it has; ``undelivered`` counts those that it says it does not have: a
    process that is killed while it holds a lock in the memory that Fast DDS shares may stop the
    transport of the others. A latched calibration has passed the gate, is no older than the one
    before, and its number stands for one content. Stars are measured at their places, and a star
    observer uses the latched calibration after a restart.
    """

    def __init__(self, vehicle: Vehicle, folder: Path) -> None:
        self._vehicle = vehicle
        given = scenario('tiny')
        params = write_set_up(given, folder)
        self._frames = [render_frame(given, index) for index in range(10)]
        self._truth: list[dict[int, Any]] = []  # pixels of the stars of each frame
        setup = load_setup(read_parameter_file(params, ()))
        track = observe.Track(setup.prior)
        for image, samples in self._frames:
            found, track = observe.observe_next(image, history(samples), setup, track)
            places = zip(found.catalog_id.tolist(), found.measured_px, strict=True)
            self._truth.append(dict(places))
        common = ('--params-file', str(params), '--log-level', 'warn')
        kept = ('-p', f'state_dir:={folder / "state"}', '-p', 'max_images:=5000')
        self._arguments = {'star_observer': common, 'calibrator': (*common, *kept)}
        self._running: dict[str, NodeProcess] = {}
        self._names: dict[str, str] = {}
        self._kills: Counter[str] = Counter()
        self._known: dict[int, list[float]] = {}  # content of the calibrations by number
        self._status: list[Any] = []
        self._latched: list[Any] = []
        self._in_flight_ns: set[int] = set()
        self._solving: Any = None
        self._solve: Any = None
        self.answered_ns: set[int] = set()
        self.sent = self.reported = self.undelivered = 0
        vehicle.node.create_subscription(StarObservations, 'observations', self._take, 5000)
        self._images = vehicle.node.create_publisher(Image, 'image', 20)
        # A small message waits behind a large one of the same participant: use a second one.
        self._tracker = Client('star_tracker')
        self._attitudes = self._tracker.node.create_publisher(QuaternionStamped, 'attitude', 1000)

    def close(self) -> None:
        """Leave the graph; the nodes are ended by their fixture."""
        self._tracker.close()

    def fly(self, seconds: float) -> None:
        """Start missing nodes, then send images and request calibrations for a time."""
        missing = [name for name in BOTH if name not in self._running]
        for name in missing:
            self._start(name)
        if 'star_observer' in missing:
            self._until_observer_is_ready()
        if 'calibrator' in missing:
            self._until_calibrator_is_ready()
        if self._known:
            self._vehicle.until(lambda: self._number_in_use() >= max(self._known))
        end_s, first = time.monotonic() + seconds, self.sent
        while time.monotonic() < end_s or self.sent == first:
            self._send()
            if not self._vehicle.holds(lambda: len(self._in_flight_ns) < _IN_FLIGHT, _ANSWER_S):
                assert not self._observer_holds_images(), f'no answer: {self._in_flight_ns}'
                self.undelivered += len(self._in_flight_ns)
                self._in_flight_ns.clear()
            if self._solving is None or self._solving.done():
                self._solving = self._solve.call_async(Trigger.Request())

    def kill_at_start(self, name: str, seconds: float) -> None:
        """Kill a node during its start, before or after it has read its state."""
        self._start(name)
        process = self._running[name].process
        self._vehicle.holds(lambda: process.poll() is not None, seconds)
        self.kill(name)

    def kill(self, *names: str) -> None:
        """Kill nodes at once, and check the messages that they have published."""
        for name in names:
            self._running[name].process.kill()
        for name in names:
            ended = self._running.pop(name)
            assert ended.wait() == -9, ended.said()
            self._kills[name] += 1
        self._vehicle.holds(lambda: False, 0.1)  # messages in flight
        if 'star_observer' in names:
            self._in_flight_ns.clear()
        if 'calibrator' in names:
            self._solving = None
        self.reported = max([self.reported, *(message.images_saved for message in self._status)])
        for message in self._latched:
            if not message.number:
                assert not self._known, 'none is active only before the first'
                continue
            content = [*message.camera.parameters, *message.covariance]
            assert message.accepted
            assert self._known.setdefault(message.number, content) == content
        self._status.clear()
        self._latched.clear()

    def _start(self, name: str) -> None:
        # A new name for each process: a dead node stays in the graph for 20 s.
        self._names[name] = f'{name}{self._kills[name]}'
        named = ('-r', f'__node:={self._names[name]}')
        self._running[name] = self._vehicle.start_node(name, *self._arguments[name], *named)

    def _until_observer_is_ready(self) -> None:
        """Wait until it is matched and answers; earlier images do not count as lost."""
        self._vehicle.until_listened(self._names['star_observer'])
        before = len(self.answered_ns)

        def answers_an_image() -> bool:
            self._send()
            return bool(self._vehicle.holds(lambda: len(self.answered_ns) > before, 1.0))

        self._vehicle.until(answers_an_image)
        self._in_flight_ns.clear()

    def _until_calibrator_is_ready(self) -> None:
        vehicle = self._vehicle
        self._status = vehicle.latched(EnsembleStatus, 'ensemble_status')
        self._latched = vehicle.latched(Calibration, 'calibration')
        service = f'{self._names["calibrator"]}/calibrate'
        self._solve = vehicle.node.create_client(Trigger, service)
        vehicle.until(lambda: self._status and self._solve.service_is_ready())
        assert self._status[0].images >= self.reported
        if self._known:
            vehicle.until(lambda: self._latched)
            assert self._latched[0].number >= max(self._known)

    def _number_in_use(self) -> int:
        """Number of the calibration that the star observer predicts with; 0 for the prior."""
        value = self._vehicle.health(self._names['star_observer'])[2].get('calibration', 'prior')
        return 0 if value == 'prior' else int(value)

    def _observer_holds_images(self) -> bool:
        """Return what a new report says; True if none comes."""
        vehicle, mine = self._vehicle, self._names['star_observer']
        vehicle.forget_health()
        vehicle.holds(lambda: vehicle.health(mine)[2])
        return bool(vehicle.health(mine)[2].get('images_waiting') != '0')

    def _send(self) -> None:
        image, samples = self._frames[self.sent % len(self._frames)]
        time_ns = _FIRST_NS + self.sent * _STEP_NS
        for around_ns in _AROUND_NS:
            xyzw = samples[1].icrf_from_star_tracker_xyzw
            self._attitudes.publish(
                attitude_to_message(time_ns + around_ns, xyzw, 'icrf', make_message)
            )
        message = image_to_message(image, 'camera', make_message)
        message.header = make_header(time_ns, 'camera', make_message)
        self._images.publish(message)
        self._in_flight_ns.add(time_ns)
        self.sent += 1

    def _take(self, message: StarObservations) -> None:
        time_ns = stamp_ns(message.header.stamp)
        self.answered_ns.add(time_ns)
        self._in_flight_ns.discard(time_ns)
        truth = self._truth[(time_ns - _FIRST_NS) // _STEP_NS % len(self._truth)]
        measured = np.reshape(message.measured_px, (-1, 2))
        for star, place in zip(message.catalog_id, measured, strict=True):
            known = truth.get(star)
            # A star near the limit may be found in only one of the passes.
            assert known is None or np.abs(known - place).max() <= _SAME_PX, star
