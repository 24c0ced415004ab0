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
import subprocess
import tempfile
import time
from typing import Any, NamedTuple

from bench import graph
from bench.frames import paper_scenario, render_frame, write_set_up
from bench.table import Table
from bench.trials import memory_mb
from starcal_ground.simulation.scenario import Scenario, scenario

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
    yield _soak(at_speed(150 if quick else 10_000))
    yield _soak(at_10_hz(0.05 if quick else 10.0))


def _title(case: Case) -> str:
    camera = case.scenario.prior.camera
    rate = f'at {case.rate_hz:g} Hz' if case.rate_hz else 'as fast as answered'
    return (
        f'{case.images} images of {camera.width} x {camera.height} {rate} through both nodes,'
        f' {MAX_IMAGES} kept, {os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")}'
    )


def _soak(case: Case) -> Table:
    graph.own_domain()
    limit = f'max_images:={MAX_IMAGES}'
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        state, log = f'state_dir:={folder / "state"}', folder / 'log'
        params = write_set_up(case.scenario, folder, magnitude_limit=case.scenario.magnitude_limit)
        with (
            graph.running('star_observer', params, log) as observer,
            graph.running('calibrator', params, log, limit, state) as calibrator,
            graph.Client() as client,
            graph.Client('star_tracker') as tracker,
        ):
            return _flown(case, client, tracker, (observer, calibrator))


def _flown(
    case: Case,
    client: graph.Client,
    tracker: graph.Client,
    nodes: tuple[subprocess.Popen[bytes], ...],
) -> Table:
    """Send the images, with a solve after each tenth of them."""
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus, StarObservations

    answers: Counter[str] = Counter()
    collected = [0]

    def take(message: Any) -> None:
        answers[message.refusal] += 1

    def take_status(message: Any) -> None:
        collected[0] = message.images

    client.collect(StarObservations, 'observations', take, latched=False)
    client.collect(EnsembleStatus, 'ensemble_status', take_status, latched=True)
    frames = [render_frame(case.scenario, index) for index in range(case.frames)]
    sender = graph.Sender(client, tracker, frames)
    client.until(lambda: client.node.count_subscribers('observations') >= 2, 'calibrator')
    calibrate = client.node.create_client(Trigger, 'calibrator/calibrate')
    client.until(calibrate.service_is_ready, 'calibrator/calibrate')
    start_s = time.monotonic()
    resident_mb, solves = [], []
    for sent in range(1, case.images + 1):
        sender.send(sent - 1, _FIRST_NS + (sent - 1) * case.step_ns, case.around_ns)
        if case.rate_hz:
            due_s = start_s + sent / case.rate_hz
            client.holds(lambda: time.monotonic() >= due_s, _LATE_S)  # noqa: B023
        elif not client.holds(lambda: sent - answers.total() < _IN_FLIGHT, _LATE_S):  # noqa: B023
            break
        if sent % (case.images // 10) == 0:
            resident_mb.append([memory_mb(node.pid) for node in nodes])
            solves.append(calibrate.call_async(Trigger.Request()))
            if not case.rate_hz:
                client.until(solves[-1].done, 'calibrator/calibrate')
            print(f'soak: {sent} images, {time.monotonic() - start_s:.0f} s,', end=' ')
            print('observer {:.1f} MB, calibrator {:.1f} MB'.format(*resident_mb[-1]), flush=True)
    took_s = time.monotonic() - start_s
    client.holds(lambda: answers.total() >= sent, _LATE_S)
    client.holds(lambda: collected[0] >= min(MAX_IMAGES, answers['']), _LATE_S)
    client.holds(lambda: all(solve.done() for solve in solves), _LATE_S)
    accepted = sum(bool(solve.done() and solve.result().success) for solve in solves)
    died = sum(node.poll() is not None for node in nodes)
    columns = (
        'images, answered, lost, refused, in the ensemble, solves, accepted, died, images/s, '
        'observer MB at 10 %, at the end, growth %, calibrator MB at 10 %, at its end, '
        'its growth %'
    )
    notes = [f'refused: {count} {name}' for name, count in answers.items() if name]
    table = Table(_title(case), columns.split(', '), notes=notes)
    answered, refused = answers.total(), answers.total() - answers['']
    cells = [
        cell
        for first, last in zip(resident_mb[0], resident_mb[-1], strict=True)
        for cell in (first, last, 100.0 * (last / first - 1.0))
    ]
    counts = (sent, answered, sent - answered, refused, collected[0], len(solves), accepted, died)
    table.add(*counts, sent / took_s, *cells)
    return table


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description='Soak both nodes at 10 Hz of 2592 x 2048.')
    parser.add_argument('--minutes', type=float, default=10.0)
    print(_soak(at_10_hz(parser.parse_args().minutes)).text())
