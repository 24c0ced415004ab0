# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attacks by untrusted text and messages: fuzzed files, and hostile messages to real nodes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import importlib.util
import json
import os
from pathlib import Path
import struct
import subprocess
import sys
import tempfile
import time
from typing import Any
import zlib

from bench import graph
from bench.attack_row import AttackRow
from bench.campaign import Campaign
from bench.fuzz_inputs import KINDS
from starcal_ros.safe_path import module_command

_CASES, _QUICK_CASES = 10_000, 100
_MOST_MB = 1000.0
_ANSWER_S = 60.0
_COMPRESSED = ('image_transport:=compressed', 'attitude_timeout_s:=0.0')
_PLANTED = ('yaml', 'json', 'typing', 'argparse', 'numpy', 'rclpy')  # that the tool imports


def rows(quick: bool) -> list[AttackRow]:
    """Every attack of this part; the short form takes a minute."""
    found = [_fuzzed(kind, _QUICK_CASES if quick else _CASES) for kind in KINDS]
    with tempfile.TemporaryDirectory() as folder:
        found += [_pipe(Path(folder)), _planted(Path(folder))]
    if not importlib.util.find_spec('rclpy'):
        print('attack: no rclpy here: messages to nodes are left out\n')
        return found
    graph.own_domain()
    with tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(Path(folder))
        found += [
            _hostile_observations(campaign),
            _long_requests(campaign),
            _deactivated(campaign, 2 if quick else 12),
            _no_clock(campaign),
            _bombs(campaign),
        ]
    return found


def _fuzzed(kind: str, count: int) -> AttackRow:
    """Cases by hypothesis in a process of their own, whose memory is theirs."""
    command = [sys.executable, '-m', 'bench.fuzz_inputs', kind, str(count)]
    name = f'hypothesis: {kind}'
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return AttackRow(name, count, 0, 0, 0, done.stderr[-200:])
    found = json.loads(done.stdout)
    failed = len(found['failures']) or int(found['peak_mb'] > _MOST_MB)
    worst = f'slowest {found["slowest_s"]:.1f} s, peak {found["peak_mb"]:.0f} MB'
    note = f'{found["read"]} read, {worst}' + ''.join(f'; {one}' for one in found['failures'][:1])
    return AttackRow(name, found['tried'], found['tried'] - failed, 0, 0, note)


def _pipe(folder: Path) -> AttackRow:
    """Named pipes and devices in place of files: answered, not waited for."""
    pipe = folder / 'pipe'
    os.mkfifo(pipe)
    (folder / 'bag').mkdir()
    os.mkfifo(folder / 'bag' / 'metadata.yaml')
    os.mkfifo(folder / 'bag' / 'a.mcap')
    tried = survived = 0
    for arguments in (
        ['inspect', pipe],
        ['inspect', '/dev/zero'],
        ['inspect', folder / 'bag'],
        ['inspect', folder / 'bag', '--params', pipe],
        ['calibrate', 'bags/tiny', '--params', '/dev/zero', '-o', folder / 'out'],
        ['compare', pipe, '/dev/zero'],
    ):
        tried += 1
        command = [*module_command('starcal_ros.cli.main'), *map(str, arguments)]
        with contextlib.suppress(subprocess.TimeoutExpired):
            done = subprocess.run(
                command, capture_output=True, text=True, check=False, timeout=_ANSWER_S
            )
            survived += done.returncode == 2 and done.stderr.count('\n') == 1
    return AttackRow('named pipes and devices as files', tried, survived, 0, 0)


def _planted(folder: Path) -> AttackRow:
    """Modules in the current folder, as in that of an untrusted bag: none is run."""
    mark = folder / 'marks'
    for name in _PLANTED:
        (folder / f'{name}.py').write_text(f'open({str(mark)!r}, "a").write({name!r})\n')
    bag = Path('bags/tiny').resolve()
    environment = {**os.environ, 'PYTHONPATH': str(Path.cwd())}
    tried = survived = 0
    for arguments in (
        ['inspect', str(bag)],
        ['campaign', 'coverage', '--trials', '1', '--workers', '1', '-o', 'study'],
    ):
        for start in (module_command('starcal_ros.cli.main', version) for version in _VERSIONS):
            tried += 1
            subprocess.run(
                [*start, *arguments],
                cwd=folder,
                env=environment,
                capture_output=True,
                check=False,
            )
            survived += not mark.exists()
    return AttackRow('modules planted in the current folder', tried, survived, 0, 0)


_VERSIONS = ((3, 10), sys.version_info[:2])


def _hostile_observations(campaign: Campaign) -> AttackRow:
    """Messages that once ended all saving: counted, and what is sound is saved after them."""
    from diagnostic_msgs.msg import DiagnosticArray

    from starcal.msg import EnsembleStatus, StarObservations

    status: list[Any] = []
    health: list[Any] = []
    folder = campaign.folder / 'observations_state'
    with (
        campaign.running('calibrator', f'state_dir:={folder}') as process,
        graph.Client() as client,
    ):
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
        publisher = client.publisher(StarObservations, 'observations')
        hostile = list(_hostile(campaign))
        for message in hostile:
            publisher.publish(message)
        for record in campaign.observations:
            publisher.publish(campaign.message(record))
        sound = len(campaign.observations)
        saved = client.holds(lambda: status and status[-1].images_saved == sound, _ANSWER_S)
        counted = _refused(status[-1]).get('bad_observations', 0)
        health.clear()
        calm = client.holds(lambda: health and health[-1].status[0].level == b'\0', _ANSWER_S)
        lost = 0 if saved else sound - status[-1].images_saved
        died = process.poll() is not None
    note = f'{sound} sound images saved after them' + ('' if calm else '; diagnostics not OK')
    return AttackRow(
        'impossible observations', len(hostile), 0 if died else counted, lost, int(not calm), note
    )


def _refused(status: Any) -> dict[str, int]:
    return {entry.reason: entry.count for entry in status.refused}


def _hostile(campaign: Campaign) -> Iterator[Any]:
    """Messages with one impossible value each."""
    record = campaign.observations[0]

    def changed(change: Callable[[Any], None]) -> Any:
        message = campaign.message(record)
        change(message)
        return message

    def array(name: str, value: float, count: int) -> Callable[[Any], None]:
        def change(message: Any) -> None:
            found = getattr(message, name)
            for k in range(min(count, len(found))):
                found[k] = value * (found[k] if value == -1.0 else 1.0)

        return change

    def stamp(sec: int, nanosec: int) -> Callable[[Any], None]:
        def change(message: Any) -> None:
            message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec

        return change

    def attitude(value: float) -> Callable[[Any], None]:
        def change(message: Any) -> None:
            for axis in 'xyzw':
                setattr(message.attitude, axis, value)

        return change

    everything = 10**6
    for change in (
        stamp(-1, 0),
        stamp(-(2**31), 0),
        stamp(2**31 - 1, 2**32 - 1),
        attitude(0.0),
        attitude(1e300),
        array('direction_icrf', 0.0, 3),
        array('direction_icrf', -1.0, everything),
        array('direction_icrf', 1e300, 1),
        array('measured_px', 1e300, 1),
        array('measured_px', -1e9, everything),
        array('covariance_px2', 1e300, 1),
        array('snr', float('inf'), 1),
    ):
        yield changed(change)
    for k in range(50):
        message = campaign.message(record)
        message.refusal = f'reason {k}'
        yield message


def _long_requests(campaign: Campaign) -> AttackRow:
    """``~/solve`` with thousands of names: refused at once."""
    from starcal.srv import Calibrate

    tried = survived = 0
    slowest_s = 0.0
    with campaign.running('calibrator') as process, graph.Client() as client:
        for method, estimate in (
            ('', ['fx'] * 1000),
            ('', ['fx'] * 100_000),
            ('', ['fx', 'fx']),
            ('', ['x' * 10**6]),
            ('m' * 10**6, []),
        ):
            tried += 1
            start_s = time.monotonic()
            answer = client.call(
                Calibrate, 'calibrator/solve', _ANSWER_S, method=method, estimate=estimate
            )
            slowest_s = max(slowest_s, time.monotonic() - start_s)
            survived += not answer.success and len(answer.message) < 1000
        if process.poll() is not None:
            survived = 0
        peak_mb = graph.resident_mb(process.pid)
    note = f'slowest answer {slowest_s:.1f} s, {peak_mb:.0f} MB after them'
    return AttackRow('~/solve with long lists', tried, survived, 0, 0, note)


def _deactivated(campaign: Campaign, times: int) -> AttackRow:
    """Calls to a node that is deactivated or cleaned up meanwhile: each is answered."""
    from lifecycle_msgs.srv import ChangeState
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus, StarObservations
    from starcal.srv import Calibrate

    tried = survived = 0
    status: list[Any] = []
    folder = campaign.folder / 'deactivated_state'
    with campaign.running('calibrator', f'state_dir:={folder}'), graph.Client() as client:
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        publisher = client.publisher(StarObservations, 'observations')
        for record in campaign.observations:
            publisher.publish(campaign.message(record))
        client.until(lambda: status and status[-1].images == 10, 'ensemble_status')
        calls = [(client.node.create_client(Calibrate, 'calibrator/solve'), Calibrate.Request())]
        for name in ('calibrate', 'rollback', 'send_camera_info'):
            service = client.node.create_client(Trigger, f'calibrator/{name}')
            calls.append((service, Trigger.Request()))
        client.until(lambda: all(one.service_is_ready() for one, _ in calls), 'services')
        for k in range(times):
            waiting = [one.call_async(request) for one, request in calls]
            client.holds(lambda: False, 0.05 * k)
            for transition in (4, 2, 1, 3) if k % 2 else (4, 3):
                request = ChangeState.Request()
                request.transition.id = transition
                client.call(ChangeState, 'calibrator/change_state', transition=request.transition)
            tried += len(waiting)
            client.holds(lambda: all(one.done() for one in waiting), _ANSWER_S)  # noqa: B023
            survived += sum(one.done() for one in waiting)
    return AttackRow('calls to a node that is deactivated', tried, survived, 0, 0)


def _no_clock(campaign: Campaign) -> AttackRow:
    """Simulated time without a /clock: diagnostics are published all the same."""
    from diagnostic_msgs.msg import DiagnosticArray

    survived = 0
    names = ('star_observer', 'calibrator')
    for name in names:
        health: list[Any] = []
        with campaign.running(name, 'use_sim_time:=true'), graph.Client() as client:
            client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
            survived += client.holds(lambda: len(health) > 2)  # noqa: B023
    return AttackRow('simulated time without a clock', len(names), survived, 0, 0)


def _bombs(campaign: Campaign) -> AttackRow:
    """PNGs that claim or inflate to gigabytes: refused, and the memory of the node stays."""
    from sensor_msgs.msg import CompressedImage

    from starcal.msg import StarObservations
    from starcal_ros.messages.fields import make_header
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    answers: list[Any] = []
    bombs = [_png(40_000, 40_000, 2**30), _png(2**31 - 1, 2**31 - 1, 2**20), _png(640, 512, 2**30)]
    with (
        campaign.running('star_observer', *_COMPRESSED) as process,
        graph.Client() as client,
    ):
        client.collect(StarObservations, 'observations', answers.append, latched=False)
        publisher = client.publisher(CompressedImage, 'image/compressed')
        for k, data in enumerate(bombs):
            header = make_header(10**18 + k, 'camera', make_message)
            publisher.publish(CompressedImage(header=header, format='png', data=data))
            client.holds(lambda: len(answers) > k, _ANSWER_S)  # noqa: B023
        survived = sum(answer.refusal in ('wrong_size', 'bad_layout') for answer in answers)
        lines = Path(f'/proc/{process.pid}/status').read_text().splitlines()
        peak_mb = next(int(line.split()[1]) for line in lines if line.startswith('VmHWM')) / 1000
    wrong = int(peak_mb > _MOST_MB)
    return AttackRow('PNG bombs', len(bombs), survived, 0, wrong, f'peak {peak_mb:.0f} MB')


def _png(width: int, height: int, raw_bytes: int) -> bytes:
    """A grey PNG of 16 bit with a size in its header and so many bytes of zeros in its rows."""

    def chunk(name: bytes, data: bytes) -> bytes:
        checked = name + data
        return struct.pack('>I', len(data)) + checked + struct.pack('>I', zlib.crc32(checked))

    deflate = zlib.compressobj(9)
    block = bytes(2**20)
    rows = b''.join(deflate.compress(block) for _ in range(raw_bytes // len(block)))
    header = chunk(b'IHDR', struct.pack('>IIBBBBB', width, height, 16, 0, 0, 0, 0))
    data = chunk(b'IDAT', rows + deflate.flush())
    return b'\x89PNG\r\n\x1a\n' + header + data + chunk(b'IEND', b'')
