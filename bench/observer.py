# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The star observer as a process, fed at a steady rate from another process.

Frames of 2592 x 2048, mono16, reliable: lost frames, latency of the observations and growth of
memory.  A few rendered frames are sent in turn, each with its own attitude and an increasing
stamp.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import importlib.util
import multiprocessing
from pathlib import Path
import statistics
import tempfile
import time
from typing import Any

from bench import graph
from bench.frames import Frame, paper_scenario, render_frame, write_set_up
from bench.table import Table
from bench.trials import memory_mb

MAGNITUDE_LIMIT = 9.0  # the default of the node: 300 to 400 stars in a frame
FRAMES = 6
RUNS = (('stock', 5.0), ('stock', 10.0), ('fastdds.xml', 10.0))  # profile, frames a second
START_S = 30.0
LATE_S = 10.0  # longest wait for the last observations
_FIRST_NS = 1_778_829_600_000_000_000
_AROUND_NS = 20_000_000  # from an image to the attitudes before and after it


def run(quick: bool) -> Iterator[Table]:
    """Feed the node at 5 and at 10 frames a second."""
    if not importlib.util.find_spec('rclpy'):
        print('observer: no rclpy here: left out\n')
        return
    columns = (
        'Fast DDS, Hz sent, frames, observed, refused, lost, stars, latency ms, worst ms, '
        'RSS MB first, after 50, after all, CPU ms/frame'
    )
    table = Table(
        'star_observer: 2592 x 2048 mono16, reliable, three processes',
        columns.split(', '),
        notes=[
            'latency: from just before the image is published until its observations',
            'are received; median and worst.  CPU: user and system time of the node, all threads.',
            'Frames count from the first answered one: earlier ones may have no subscriber.',
        ],
    )
    print('observer: rendering frames', flush=True)
    scenario = paper_scenario(MAGNITUDE_LIMIT)
    frames = [render_frame(scenario, index) for index in range(2 if quick else FRAMES)]
    for profile, rate_hz in RUNS[:1] if quick else RUNS:
        print(f'observer: {rate_hz:g} frames a second, Fast DDS {profile}', flush=True)
        with tempfile.TemporaryDirectory() as folder, graph.profile(profile):
            params = write_set_up(scenario, Path(folder), magnitude_limit=MAGNITUDE_LIMIT)
            table.add(profile, rate_hz, *_feed(params, frames, rate_hz, 10 if quick else 120))
    yield table


def _feed(params: Path, frames: list[Frame], rate_hz: float, count: int) -> tuple[Any, ...]:
    """Send frames and collect observations; return the cells of a row after the rate."""
    from starcal.msg import StarObservations

    graph.own_domain()
    arrived: dict[int, tuple[float, str, int]] = {}
    started: list[int] = []
    resident_mb: dict[int, float] = {}

    def take(message: Any) -> None:
        time_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if time_ns < _FIRST_NS:
            if not started:
                started.append(time_ns)
                ours.send('somebody listens')
            return
        arrived[time_ns] = (time.monotonic(), message.refusal, len(message.catalog_id))
        resident_mb[len(arrived)] = memory_mb(process.pid)

    log = params.with_name('log')
    with graph.running('star_observer', params, log) as process, graph.Client() as client:
        spawn = multiprocessing.get_context('spawn')
        ours, theirs = spawn.Pipe()
        client.collect(StarObservations, 'observations', take, latched=False)
        publisher = spawn.Process(target=_publish, args=(frames, rate_hz, count, theirs))
        publisher.start()
        start_cpu_s = graph.processor_s(process.pid)
        if not client.holds(ours.poll, 2 * START_S + count / rate_hz):
            publisher.kill()
            raise RuntimeError('the publisher did not finish')
        sent_s: dict[int, float] = ours.recv()
        client.holds(lambda: len(arrived) >= count, LATE_S)
        publisher.terminate()  # it stays to resend its last images
        publisher.join()
        if not arrived:
            raise RuntimeError('no answer from the star observer')
        processor_ms = 1e3 * (graph.processor_s(process.pid) - start_cpu_s) / len(arrived)
    for number, time_ns in enumerate(sent_s):
        if time_ns not in arrived:
            print(f'observer: frame {number} of {count} was not answered', flush=True)
    late_ms = [1e3 * (arrived[t][0] - sent_s[t]) for t in sent_s if t in arrived]
    refusals = Counter(refusal for _, refusal, _ in arrived.values())
    refused = ', '.join(f'{n} {name}' for name, n in refusals.items() if name) or '0'
    lost = len(sent_s.keys() - arrived.keys())
    stars = int(statistics.median(stars for _, _, stars in arrived.values()))
    return (
        *(len(sent_s), refusals[''], refused, lost, stars),
        *(statistics.median(late_ms), max(late_ms), resident_mb[1]),
        *(resident_mb.get(min(50, count)), resident_mb[len(arrived)], processor_ms),
    )


def _publish(frames: list[Frame], rate_hz: float, count: int, pipe: Any) -> None:
    """In a separate process: send frames at a steady rate and report their times."""
    sent_s: dict[int, float] = {}
    with graph.Client('camera') as camera, graph.Client('star_tracker') as tracker:
        sender = graph.Sender(camera, tracker, frames)

        def send(k: int, time_ns: int) -> None:
            sent_s[time_ns] = time.monotonic()
            sender.send(k, time_ns, (-_AROUND_NS, _AROUND_NS))

        # Discovery is not symmetric: wait for an answer.
        for k in range(round(START_S)):
            send(-1, _FIRST_NS - 10**9 * (100 - k))  # not the next frame
            if pipe.poll(1.0):
                break
        sent_s.clear()
        start_s = time.monotonic() + 1.0
        for k in range(count):
            time.sleep(max(0.0, start_s + k / rate_hz - time.monotonic()))
            send(k, _FIRST_NS + round(k / rate_hz * 1e9))
        pipe.send(sent_s)
        time.sleep(2 * LATE_S)
