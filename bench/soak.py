# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Long runs through both nodes, on the real graph: every image is answered, and memory stays.

Two hours of flight at speed: 10,000 images of 640 x 512, stamps 0.72 s apart, as fast as they are
observed, at most four in flight.  And ten minutes at 10 Hz of 2592 x 2048, for which
``python -m bench.soak --minutes N`` runs alone.  A few frames are sent in turn, each with its own
attitude.  The middleware is that of RMW_IMPLEMENTATION.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
import importlib.util
import os
from pathlib import Path
import tempfile
import time
from typing import Any, NamedTuple

from bench import graph
from bench.frames import paper_scenario, render_frame, write_set_up
from bench.table import Table
from starcal_ros.arrays import Floats
from starcal_ros.formats.messages.image_messages import image_to_message
from starcal_ros.formats.messages.telemetry import attitude_to_message
from starcal_ros.studies.simulation.scenario import Scenario, scenario

MAX_IMAGES = 50
MAGNITUDE_LIMIT = 9.0  # the default of the node: 300 to 400 stars in a large frame
_FIRST_NS = 1_778_829_600_000_000_000
_IN_FLIGHT = 4
_LATE_S = 30.0


class Case(NamedTuple):
    """Images of a run; ``rate_hz`` 0: as fast as they are answered."""

    scenario: Scenario
    frames: int
    images: int
    rate_hz: float
    step_ns: int
    around_ns: tuple[int, ...]  # from an image to the attitudes about it


def at_speed(count: int) -> Case:
    """Return small images, as fast as they are observed."""
    around_ns = (-200_000_000, -20_000_000, 20_000_000, 200_000_000)
    return Case(scenario('tiny'), 10, count, 0.0, 720_000_000, around_ns)


def at_10_hz(minutes: float) -> Case:
    """Return large images at 10 Hz."""
    around_ns = (-20_000_000, 20_000_000)
    count = round(600 * minutes)
    return Case(paper_scenario(MAGNITUDE_LIMIT), 6, count, 10.0, 100_000_000, around_ns)


def run(quick: bool) -> Iterator[Table]:
    """Send the images of both cases; memory after a tenth of them and at the end."""
    if not importlib.util.find_spec('rclpy'):
        print('soak: no rclpy here: left out\n')
        return
    yield _table(at_speed(150 if quick else 10_000))
    yield _table(at_10_hz(0.05 if quick else 10.0))


def _table(case: Case) -> Table:
    graph.own_domain()
    with tempfile.TemporaryDirectory() as folder:
        return _soak(Path(folder), case)


def _serialised(case: Case) -> list[tuple[bytes, Floats]]:
    """Return messages of frames, and the attitude of each."""
    from rclpy.serialization import serialize_message

    from starcal_ros.ros.lifecycle_node.message_factory import make_message

    frames = [render_frame(case.scenario, index) for index in range(case.frames)]
    return [
        (
            serialize_message(image_to_message(image, 'camera', make_message)),
            samples[1].icrf_from_star_tracker_xyzw,
        )
        for image, samples in frames
    ]


def _title(case: Case) -> str:
    camera = case.scenario.prior.camera
    rate = f'at {case.rate_hz:g} Hz' if case.rate_hz else 'as fast as answered'
    return (
        f'{case.images} images of {camera.width} x {camera.height} {rate} through both nodes,'
        f' {MAX_IMAGES} kept, {os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")}'
    )


def _soak(folder: Path, case: Case) -> Table:
    from geometry_msgs.msg import QuaternionStamped
    from sensor_msgs.msg import Image
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus, StarObservations
    from starcal_ros.ros.lifecycle_node.message_factory import make_message

    params = write_set_up(case.scenario, folder, magnitude_limit=case.scenario.magnitude_limit)
    ready = _serialised(case)
    answers: Counter[str] = Counter()
    collected = [0]
    limit = f'max_images:={MAX_IMAGES}'
    state = f'state_dir:={folder / "state"}'
    memory_mb: dict[int, tuple[float, float]] = {}

    def take(message: Any) -> None:
        answers[message.refusal] += 1

    def take_status(message: Any) -> None:
        collected[0] = message.images

    with (
        graph.running('star_observer', params, folder / 'log') as observer,
        graph.running('calibrator', params, folder / 'log', limit, state) as calibrator,
        graph.Client() as client,
        # A small message waits behind a large one of the same participant: use a second one.
        graph.Client('star_tracker') as tracker,
    ):
        client.collect(StarObservations, 'observations', take, latched=False)
        client.collect(EnsembleStatus, 'ensemble_status', take_status, latched=True)
        images = client.publisher(Image, 'image', 20)
        attitudes = tracker.publisher(QuaternionStamped, 'attitude')
        client.until(lambda: client.node.count_subscribers('observations') >= 2, 'calibrator')
        calibrate = client.node.create_client(Trigger, 'calibrator/calibrate')
        client.until(calibrate.service_is_ready, 'calibrator/calibrate')
        start_s = time.monotonic()
        marks = {case.images // 10 * k for k in range(1, 11)}
        solves = []
        for k in range(case.images):
            content, xyzw = ready[k % len(ready)]
            time_ns = _FIRST_NS + k * case.step_ns
            for around_ns in case.around_ns:
                attitudes.publish(
                    attitude_to_message(time_ns + around_ns, xyzw, 'icrf', make_message)
                )
            images.publish(graph.stamped(content, time_ns))
            sent = k + 1
            if case.rate_hz:
                due_s = start_s + sent / case.rate_hz
                client.holds(lambda: time.monotonic() >= due_s, _LATE_S)  # noqa: B023
            elif not client.holds(lambda: sent - answers.total() < _IN_FLIGHT, _LATE_S):  # noqa: B023
                break
            if sent in marks:
                memory_mb[sent] = (
                    graph.resident_mb(observer.pid),
                    graph.resident_mb(calibrator.pid),
                )
                solves.append(calibrate.call_async(Trigger.Request()))
                if not case.rate_hz:
                    client.until(solves[-1].done, 'calibrator/calibrate')
                print(f'soak: {sent} images, {time.monotonic() - start_s:.0f} s,', end=' ')
                print(
                    'observer {:.1f} MB, calibrator {:.1f} MB'.format(*memory_mb[sent]), flush=True
                )
        took_s = time.monotonic() - start_s
        client.holds(lambda: answers.total() >= sent, _LATE_S)
        client.holds(lambda: collected[0] >= min(MAX_IMAGES, answers['']), _LATE_S)
        client.holds(lambda: all(solve.done() for solve in solves), _LATE_S)
        accepted = sum(bool(solve.done() and solve.result().success) for solve in solves)
        died = sum(process.poll() is not None for process in (observer, calibrator))
    table = Table(
        _title(case),
        (
            *('images', 'answered', 'lost', 'refused', 'in the ensemble', 'solves', 'accepted'),
            *('died', 'images/s', 'observer MB at 10 %', 'at the end', 'growth %'),
            *('calibrator MB at 10 %', 'at its end', 'its growth %'),
        ),
        notes=[f'refused: {count} {name}' for name, count in answers.items() if name],
    )
    cells: list[Any] = []
    for first, last in zip(memory_mb[min(memory_mb)], memory_mb[max(memory_mb)], strict=True):
        cells += [first, last, 100.0 * (last / first - 1.0)]
    refused = answers.total() - answers['']
    table.add(
        *(sent, answers.total(), sent - answers.total(), refused, collected[0], len(solves)),
        *(accepted, died, sent / took_s, *cells),
    )
    return table


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description='Soak both nodes at 10 Hz of 2592 x 2048.')
    parser.add_argument('--minutes', type=float, default=10.0)
    print(_table(at_10_hz(parser.parse_args().minutes)).text())
