# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images through both nodes while nodes are killed, with checks of all published messages."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
import time
from typing import Any

from forked_process import ForkedNode  # type: ignore[import-not-found]
import numpy as np

from bench import graph
from bench.frames import history, render_frame, write_set_up
from starcal_ground.bag_writer import attitude_to_message, image_to_message
from starcal_ground.simulation import scenario
from starcal_ros.formats.messages.message_codec import make_header, stamp_ns
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import StarObservations

_FIRST_NS = 1_778_829_600_000_000_000
_STEP_NS = 1_000_000_000
_AROUND_NS = (-200_000_000, -20_000_000, 20_000_000, 200_000_000)
_IN_FLIGHT = 4
_ANSWER_S = 120.0
# Centroids depend on the prediction by much less than their noise of 0.05 px.
_SAME_PX = 0.5


class Flight:
    """
    Both nodes with images and requests in flight, and the record of their answers.

    ``lost`` counts images that the calibrator reported as saved but did not have after a restart,
    and images that a running star observer has but does not answer.  ``undelivered`` counts those
    that it says it does not have: a process that is killed while it holds a lock in the memory
    that Fast DDS shares may stop the transport of the others.  ``wrong`` counts latched
    calibrations that the gate refused, that are older than a previous one, or whose number had
    another content; and stars measured at a wrong place, or a star observer that does not use a
    latched calibration after a restart.
    """

    NODES = ('star_observer', 'calibrator')

    def __init__(self, campaign: Campaign, state: Path) -> None:
        self._campaign = campaign
        kept = (f'state_dir:={state}', 'max_images:=5000')
        self._values = {'star_observer': (), 'calibrator': kept}
        self._running: dict[str, Any] = {}
        self._names: dict[str, str] = {}
        self._known: dict[int, list[float]] = {}  # content of the calibrations by number
        self._status: list[Any] = []
        self._latched: list[Any] = []
        self._health: dict[str, dict[str, str]] = {}
        self._answered_ns: set[int] = set()
        self._in_flight_ns: set[int] = set()
        self._solving: Any = None
        self._solve: Any = None
        self.sent = self.reported = 0
        self.kills: Counter[str] = Counter()
        self.lost: Counter[str] = Counter()
        self.undelivered: Counter[str] = Counter()
        self.wrong: Counter[str] = Counter()
        self.died: Counter[str] = Counter()
        self._truth = [
            dict(zip(one.catalog_id.tolist(), one.measured_px, strict=True))
            for one in campaign.observations
        ]

    @property
    def answered(self) -> int:
        """Number of images with an answer."""
        return len(self._answered_ns)

    def __enter__(self) -> Flight:
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import QuaternionStamped
        from sensor_msgs.msg import Image

        from starcal.msg import StarObservations

        self._client = graph.Client()
        # A small message waits behind a large one of the same participant: use a second one.
        self._tracker = graph.Client('star_tracker')
        self._client.collect(StarObservations, 'observations', self._take, latched=False)
        self._client.collect(DiagnosticArray, '/diagnostics', self._take_health, latched=False)
        self._images = self._client.node.create_publisher(Image, 'image', 20)
        self._attitudes = self._tracker.node.create_publisher(QuaternionStamped, 'attitude', 1000)
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            graph.stop(process)
        self._tracker.__exit__()
        self._client.__exit__()

    def fly(self, seconds: float) -> None:
        """Start missing nodes, then send images and request calibrations for a time."""
        from std_srvs.srv import Trigger

        missing = [name for name in self.NODES if name not in self._running]
        for name in missing:
            self._start(name)
        for name in missing:
            is_observer = name == 'star_observer'
            if not (self._observer_is_ready() if is_observer else self._calibrator_is_ready()):
                self._running.pop(name).kill()
                self.died[name] += 1
                return
        if self._known:
            newest = str(max(self._known))
            mine = self._names['star_observer']
            taken = self._client.holds(
                lambda: int(self._said(mine, 'calibration', 'prior', '0')) >= int(newest)
            )
            self.wrong['star_observer'] += not taken
        end_s = time.monotonic() + seconds
        first = self.sent
        while time.monotonic() < end_s or self.sent == first:
            self._send()
            if not self._client.holds(lambda: len(self._in_flight_ns) < _IN_FLIGHT, _ANSWER_S):
                count = self.lost if self._observer_holds_images() else self.undelivered
                count['star_observer'] += len(self._in_flight_ns)
                self._in_flight_ns.clear()
            if self._solving is None or self._solving.done():
                self._solving = self._solve.call_async(Trigger.Request())

    def kill_at_start(self, name: str, seconds: float) -> None:
        """Kill a node during its start, before or after it has read its state."""
        self._start(name)
        self._client.holds(lambda: self._running[name].poll() is not None, seconds)
        self.kill(name)

    def kill(self, *names: str) -> None:
        """Kill nodes at once, and check the messages that they have published."""
        for name in names:
            self._running[name].kill()
        for name in names:
            self.died[name] += self._running.pop(name).wait() != -9
            self.kills[name] += 1
        self._client.holds(lambda: False, 0.1)  # messages in flight
        if 'star_observer' in names:
            self._in_flight_ns.clear()
        if 'calibrator' in names:
            self._solving = None
        self.reported = max([self.reported, *(message.images_saved for message in self._status)])
        for message in self._latched:
            if not message.number:  # none is active: only before the first
                self.wrong['calibrator'] += bool(self._known)
                continue
            content = [*message.camera.parameters, *message.covariance]
            self.wrong['calibrator'] += not message.accepted
            self.wrong['calibrator'] += self._known.setdefault(message.number, content) != content
        self._status.clear()
        self._latched.clear()

    def _start(self, name: str) -> None:
        # A new name for each process: a dead node stays in the graph for 20 s.
        self._names[name] = f'{name}{self.kills[name]}'
        log = self._campaign.log
        log.touch()
        arguments = ['--ros-args', '--params-file', str(self._campaign.params)]
        arguments += [word for value in self._values[name] for word in ('-p', value)]
        arguments += ['-r', f'__node:={self._names[name]}', '--log-level', 'warn']
        self._running[name] = ForkedNode(name, arguments, log)

    def _observer_is_ready(self) -> bool:
        """Return True once it is matched and answers; earlier images do not count as lost."""
        mine, before = self._names['star_observer'], self.answered
        if not self._client.holds(lambda: int(self._said(mine, 'listeners', '', '0')) >= 1):
            return False
        for _ in range(int(_ANSWER_S)):
            self._send()
            if self._client.holds(lambda: self.answered > before, 1.0):
                self._in_flight_ns.clear()
                return True
        return False

    def _observer_holds_images(self) -> bool:
        """Return what a new report says; True if none comes."""
        mine = self._names['star_observer']
        self._health.pop(mine, None)
        self._client.holds(lambda: mine in self._health)
        return self._said(mine, 'images_waiting', '', '1') != '0'

    def _calibrator_is_ready(self) -> bool:
        from std_srvs.srv import Trigger

        from starcal.msg import Calibration, EnsembleStatus

        client = self._client
        client.collect(EnsembleStatus, 'ensemble_status', self._status.append, latched=True)
        client.collect(Calibration, 'calibration', self._latched.append, latched=True)
        self._solve = client.node.create_client(Trigger, f'{self._names["calibrator"]}/calibrate')
        if not client.holds(lambda: self._status and self._solve.service_is_ready()):
            return False
        self.lost['calibrator'] += max(0, self.reported - self._status[0].images)
        if self._known:
            client.holds(lambda: self._latched)
            newest = self._latched[0].number if self._latched else 0
            self.wrong['calibrator'] += newest < max(self._known)
        return True

    def _said(self, node: str, key: str, none: str, instead: str) -> str:
        """Value of the newest diagnostics of a node."""
        value = self._health.get(node, {}).get(key, instead)
        return instead if value == none else value

    def _send(self) -> None:
        from starcal_ros.ros.node import make_message

        image, samples = self._campaign.frames[self.sent % len(self._campaign.frames)]
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

    def _take(self, message: Any) -> None:
        time_ns = stamp_ns(message.header.stamp)
        self._answered_ns.add(time_ns)
        self._in_flight_ns.discard(time_ns)
        truth = self._truth[(time_ns - _FIRST_NS) // _STEP_NS % len(self._truth)]
        measured = np.reshape(message.measured_px, (-1, 2))
        for star, place in zip(message.catalog_id, measured, strict=True):
            known = truth.get(star)
            # A star near the limit may be found in only one of the passes.
            if known is not None and np.abs(known - place).max() > _SAME_PX:
                self.wrong['star_observer'] += 1

    def _take_health(self, message: Any) -> None:
        status = message.status[0]
        node = status.name.removeprefix('starcal: ')
        self._health[node] = {value.key: value.value for value in status.values}


class Campaign:
    """Ten small frames, their observations, and the parameter file for nodes."""

    def __init__(self, folder: Path) -> None:
        self.scenario = scenario.scenario('tiny')
        self.params = write_set_up(self.scenario, folder)
        self.log = folder / 'log'
        self.frames = [render_frame(self.scenario, index) for index in range(10)]
        self.setup = load_setup(read_parameter_file(self.params, ()))
        self.observations: list[StarObservations] = []
        track = observe.Track(self.setup.prior)
        for image, samples in self.frames:
            found, track = observe.observe_next(image, history(samples), self.setup, track)
            self.observations.append(found)
