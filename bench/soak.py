# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Two hours of flight at speed: 10,000 images through both nodes, on the real graph.

A few frames of 640 x 512 are sent in turn, each with its own attitude, with stamps 0.72 s apart,
as fast as they are observed, at most four in flight.  Every image must be answered, and the memory
of the nodes must not grow once the ensemble is full.
"""

from __future__ import annotations

from collections import Counter
import importlib.util
from pathlib import Path
import tempfile
import time
from typing import Any

from bench import graph
from bench.frames import render_frame, write_set_up
from bench.table import Table
from starcal_ros.messages.fields import make_header
from starcal_ros.messages.images import image_to_message
from starcal_ros.messages.telemetry import attitude_to_message
from starcal_ros.simulation import scenario as synthetic

FRAMES = 10
MAX_IMAGES = 50
_FIRST_NS = 1_778_829_600_000_000_000
_STEP_NS = 720_000_000
_AROUND_NS = (-200_000_000, -20_000_000, 20_000_000, 200_000_000)
_IN_FLIGHT = 4
_LATE_S = 30.0


def run(quick: bool) -> list[Table]:
    """Send the images; memory after a tenth of them and at the end."""
    if not importlib.util.find_spec('rclpy'):
        print('soak: no rclpy here: left out\n')
        return []
    graph.own_domain()
    count = 150 if quick else 10_000
    with tempfile.TemporaryDirectory() as folder:
        table = _soak(Path(folder), count)
    print(table.text())
    return [table]


def _soak(folder: Path, count: int) -> Table:
    from geometry_msgs.msg import QuaternionStamped
    from sensor_msgs.msg import Image
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus, StarObservations
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    scenario = synthetic.scenario('tiny')
    params = write_set_up(scenario, folder)
    frames = [render_frame(scenario, index) for index in range(FRAMES)]
    ready = [
        (image_to_message(image, 'camera', make_message), samples[1]) for image, samples in frames
    ]
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
        start_s = time.monotonic()
        marks = {count // 10 * k for k in range(1, 11)}
        solves = accepted = 0
        for k in range(count):
            message, sample = ready[k % FRAMES]
            time_ns = _FIRST_NS + k * _STEP_NS
            for around_ns in _AROUND_NS:
                xyzw = sample.icrf_from_star_tracker_xyzw
                attitudes.publish(
                    attitude_to_message(time_ns + around_ns, xyzw, 'icrf', make_message)
                )
            message.header = make_header(time_ns, 'camera', make_message)
            images.publish(message)
            sent = k + 1
            if not client.holds(lambda: sent - answers.total() < _IN_FLIGHT, _LATE_S):  # noqa: B023
                break
            if sent in marks:
                memory_mb[sent] = (
                    graph.resident_mb(observer.pid),
                    graph.resident_mb(calibrator.pid),
                )
                accepted += client.call(Trigger, 'calibrator/calibrate').success
                solves += 1
                print(f'soak: {sent} images, {time.monotonic() - start_s:.0f} s,', end=' ')
                print(
                    'observer {:.1f} MB, calibrator {:.1f} MB'.format(*memory_mb[sent]), flush=True
                )
        client.holds(lambda: answers.total() >= sent, _LATE_S)
        client.holds(lambda: collected[0] >= min(MAX_IMAGES, answers['']), _LATE_S)
        took_s = time.monotonic() - start_s
        died = sum(process.poll() is not None for process in (observer, calibrator))
    table = Table(
        f'{count} images of 640 x 512 through both nodes, {MAX_IMAGES} kept in the ensemble',
        (
            *('images', 'answered', 'lost', 'refused', 'in the ensemble', 'solves', 'accepted'),
            *('died', 'images/s', 'observer MB at 10 %', 'at the end', 'growth %'),
            *('calibrator MB at 10 %', 'at its end', 'its growth %'),
        ),
    )
    cells: list[Any] = []
    for first, last in zip(memory_mb[min(memory_mb)], memory_mb[max(memory_mb)], strict=True):
        cells += [first, last, 100.0 * (last / first - 1.0)]
    refused = answers.total() - answers['']
    table.add(
        *(sent, answers.total(), sent - answers.total(), refused, collected[0], solves, accepted),
        *(died, sent / took_s, *cells),
    )
    return table
