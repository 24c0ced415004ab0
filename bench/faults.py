# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Faults on real nodes: malformed messages, kills, full disks, duplicate nodes, damaged bags.

Each row gives the number of faults and their effects: lost messages, wrong results, nodes that
died.  All three must be 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import importlib.util
from pathlib import Path
import random
import shutil
import subprocess
import sys
import tempfile
from typing import Any

import cv2
import numpy as np

from bench import graph
from bench.campaign import Campaign
from bench.table import Table
from starcal_ros.bag import reader
from starcal_ros.calibrator.archive import Archive
from starcal_ros.errors import BagError
from starcal_ros.messages.calibration import calibration_to_message
from starcal_ros.messages.fields import make_header
from starcal_ros.messages.images import image_to_message
from starcal_ros.messages.telemetry import attitude_to_message
from starcal_ros.records import StarObservations
from starcal_ros.simulation import bag as simulated_bag

COLUMNS = ('fault', 'node', 'times', 'what', 'answered', 'lost', 'wrong', 'died')
_ANSWER_S = 60.0
# Fields that may be NaN or infinite by the interface document.
_MAY_BE_INFINITE = frozenset(
    [
        'temperature_degc',
        'predicted_sigma',
        'attitude_gap_s',
        'found',
        'limit',
        'shape_px',
        'shape_p_value',
        'rotation_arcsec',
        'p_value',
    ]
)


def run(quick: bool) -> list[Table]:
    """Inject every fault a few times, or as often as required."""
    if not importlib.util.find_spec('rclpy'):
        print('faults: no rclpy here: left out\n')
        return []
    graph.own_domain()
    table = Table('Faults: lost, wrong and died must be 0', COLUMNS)
    with tempfile.TemporaryDirectory() as folder:
        campaign = Campaign(Path(folder))
        for fault, quick_times, times in (
            (_damaged_bags, 40, 5000),
            (_hostile_to_observer, 20, 10_000),
            (_hostile_to_calibrator, 20, 10_000),
            (_killed, 2, 50),
            (_no_room, 1, 5),
            (_many_callers, 10, 10),
        ):
            for row in fault(campaign, quick_times if quick else times):
                table.add(*row)
                print('faults:', *row, flush=True)
    print()
    print(table.text())
    return [table]


def _damaged_bags(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    """Flipped bits and truncation: every message read was written, every loss is reported."""
    folder = campaign.folder / 'bag'
    simulated_bag.write_bag(campaign.scenario, folder)
    whole = next(folder.glob('*.mcap')).read_bytes()
    sound = list(reader.read_raw([folder]))
    choose = random.Random(1)
    silent = wrong = failed = 0
    file = campaign.folder / 'damaged.mcap'
    for _ in range(times):
        damaged = bytearray(whole)
        for _ in range(choose.randint(1, 3)):
            damaged[choose.randrange(8, len(whole))] ^= 1 << choose.randrange(8)
        size = len(whole) if choose.random() < 0.5 else choose.randrange(8, len(whole))
        file.write_bytes(damaged[:size])
        said: list[str] = []
        try:
            read = list(reader.read_raw([file], on_damage=said.append))
        except BagError:
            continue
        except Exception:
            failed += 1
            continue
        left = iter(sound)
        wrong += not all(any(message == one for one in left) for message in read)
        silent += len(read) < len(sound) and not said
    yield 'bits flipped, ends cut off', 'bag reader', times, 'bags', times, silent, wrong, failed


def _hostile_to_observer(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    from geometry_msgs.msg import QuaternionStamped, TwistStamped
    from sensor_msgs.msg import CompressedImage, Image, Temperature

    from starcal.msg import Calibration
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    image, samples = campaign.frames[0]
    small = image_to_message(image, 'camera', make_message)
    small.height, small.width, small.step, small.data = 4, 4, 8, bytes(32)
    attitude = attitude_to_message(
        image.time_ns, samples[1].icrf_from_star_tracker_xyzw, 'icrf', make_message
    )
    others: list[tuple[Any, str, Any]] = [
        (QuaternionStamped, 'attitude', attitude),
        (TwistStamped, 'velocity', TwistStamped(header=small.header)),
        (Temperature, 'temperature', Temperature(header=small.header)),
        (Calibration, 'calibration', _calibration(campaign)),
    ]
    yield from _hostile(campaign, [(Image, 'image', small), *others], times)
    png = CompressedImage(header=small.header, format='mono16; png compressed')
    png.data = _png(image.pixels[:4, :4])
    compressed = [(CompressedImage, 'image/compressed', png)]
    yield from _hostile(campaign, compressed, times, 'image_transport:=compressed')


def _png(pixels: Any) -> bytes:
    return cv2.imencode('.png', pixels)[1].tobytes()


def _hostile(
    campaign: Campaign, inputs: list[tuple[Any, str, Any]], times: int, *more: str
) -> Iterator[tuple[Any, ...]]:
    """Mutants on inputs and services of a node; then it must still work."""
    from sensor_msgs.msg import CameraInfo

    from starcal.msg import StarObservations

    answers: list[Any] = []
    bad: list[str] = []
    name = 'star_observer'
    values = ('attitude_timeout_s:=0.0', 'image_queue:=1000', 'camera_info_per_image:=true')
    with campaign.running(name, *values, *more) as process, graph.Client() as client:
        client.collect(StarObservations, 'observations', _finite(answers, bad), latched=False)
        client.collect(CameraInfo, 'image_camera_info', _finite([], bad), latched=False)
        count = _Taken(client, name)
        for kind, topic, template in inputs:
            is_image = topic.startswith('image')
            publisher = client.publisher(kind, topic, latched=topic == 'calibration')
            before = len(answers)
            if is_image:
                sent = _send_images(client, publisher, template, times, answers)
                answered = len(answers) - before
            else:
                # The reader of a latched topic holds one message: wait for the node after each.
                held = 1 if topic == 'calibration' else 1500
                sent, answered = times, _send(client, publisher, template, times, count, held)
            died = int(process.poll() is not None)
            yield (
                *('hostile messages', name, times, topic, answered),
                *(max(0, sent - answered), len(bad), died),
            )
            bad.clear()
            if died:
                return
        if not more:
            yield from _hostile_requests(client, process, name, times)
        used = _measures_a_sound_image(campaign, client, answers, inputs[0][1])
        yield (
            *('a sound image after these', name, 1, inputs[0][1], int(used)),
            *(int(not used), len(bad), int(process.poll() is not None)),
        )


def _measures_a_sound_image(
    campaign: Campaign, client: graph.Client, answers: list[Any], topic: str
) -> bool:
    """Return True if one of five good images, stamped far ahead of all others, gives its stars."""
    from geometry_msgs.msg import QuaternionStamped
    from sensor_msgs.msg import CompressedImage, Image

    from starcal.msg import Calibration
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    client.publisher(Calibration, 'calibration', latched=True).publish(_calibration(campaign))
    attitudes = client.publisher(QuaternionStamped, 'attitude')
    images = client.publisher(Image if topic == 'image' else CompressedImage, topic)
    image, samples = campaign.frames[0]
    message = image_to_message(image, 'camera', make_message)
    if topic != 'image':
        message = CompressedImage(format='mono16; png compressed', data=_png(image.pixels))
    stars = set(campaign.observations[0].catalog_id.tolist())
    for k in range(1, 6):  # the first ones may arrive before their attitude
        time_ns = image.time_ns + k * 10**12
        for sample_ns in range(time_ns - 10**9, time_ns + 2 * 10**9, 5 * 10**8 + 1):
            xyzw = samples[1].icrf_from_star_tracker_xyzw
            attitudes.publish(attitude_to_message(sample_ns, xyzw, 'icrf', make_message))
        client.holds(lambda: False, 0.5)
        message.header = make_header(time_ns, 'camera', make_message)
        before = len(answers)
        images.publish(message)
        client.holds(lambda: len(answers) > before, _ANSWER_S)  # noqa: B023
        if len(answers) == before or answers[-1].refusal:
            continue
        # Some of them are near the detection limit.
        if len(stars & set(answers[-1].catalog_id)) > 0.9 * len(stars):
            return True
    return False


class _Taken:
    """Number of messages that a node has received, from its diagnostics."""

    def __init__(self, client: graph.Client, node: str) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from lifecycle_msgs.srv import GetState

        self._client, self._name = client, f'starcal: {node}'
        self._values: dict[str, str] = {}
        self._state = client.node.create_client(GetState, f'{node}/get_state')
        self._ask = GetState.Request()
        client.collect(DiagnosticArray, '/diagnostics', self._take, latched=False)
        client.until(lambda: self._values, 'diagnostics')
        client.until(self._state.service_is_ready, 'get_state')

    def __call__(self) -> int:
        """Number of messages received, up to a second old."""
        return int(self._values['messages'])

    def pass_through(self) -> None:
        """Wait until the node has answered a call, and so processed all earlier messages."""
        future = self._state.call_async(self._ask)
        self._client.until(future.done, 'get_state')

    def _take(self, message: Any) -> None:
        status = message.status[0]
        if status.name == self._name:
            self._values = {value.key: value.value for value in status.values}


def _send_images(
    client: graph.Client, publisher: Any, template: Any, times: int, answers: list[Any]
) -> int:
    """Publish mutants no faster than they are answered; return the number of decodable ones."""
    from rclpy.serialization import deserialize_message

    from bench.hostile import send_mutants

    before, sent = len(answers), 0

    def send(mutant: Any) -> None:
        nonlocal sent
        sent += _can_be_decoded(mutant, type(template), deserialize_message)
        publisher.publish(mutant)
        client.holds(lambda: sent - (len(answers) - before) < 100, _ANSWER_S)

    send_mutants(template, times, send)
    client.holds(lambda: len(answers) - before >= sent, _ANSWER_S)
    return sent


def _send(
    client: graph.Client, publisher: Any, template: Any, times: int, taken: _Taken, held: int
) -> int:
    """
    Publish mutants until the node has received a number of them; return that number.

    At most ``held`` messages are in flight, so that a reader with that history loses none.
    """
    from rclpy.serialization import deserialize_message

    from bench.hostile import send_mutants

    before, sent = taken(), 0

    def send(mutant: Any) -> None:
        nonlocal sent
        publisher.publish(mutant)
        sent += _can_be_decoded(mutant, type(template), deserialize_message)
        if held == 1:
            taken.pass_through()  # acknowledgements arrive only with a heartbeat
        else:
            client.holds(lambda: sent - (taken() - before) < held, _ANSWER_S)

    for series in range(20):  # replace those that cannot be decoded
        missing = times - (taken() - before)
        if missing <= 0:
            break
        send_mutants(template, missing + missing // 10 + 2, send, series)
        client.holds(
            lambda: taken() - before >= sent, 3.0
        )  # diagnostics are published every second
    return taken() - before


def _can_be_decoded(mutant: Any, kind: Any, deserialize: Callable[[bytes, Any], Any]) -> bool:
    if not isinstance(mutant, bytes):
        return True
    try:
        deserialize(mutant, kind)
    except Exception:
        return False
    return True


_AT_ONCE = 8  # requests in flight
_SHUTDOWNS = (5, 6, 7)  # a node rightly executes it


def _hostile_requests(
    client: graph.Client, process: Any, name: str, times: int
) -> Iterator[tuple[Any, ...]]:
    """Mutants of the requests that every node answers; afterwards it is active again."""
    from lifecycle_msgs.srv import ChangeState, GetState
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters, SetParametersAtomically

    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=8.0)
    parameters = [Parameter(name='magnitude_limit', value=value)]
    change = ChangeState.Request()
    change.transition.id = 1
    for kind, service, request in (
        (SetParameters, 'set_parameters', SetParameters.Request(parameters=parameters)),
        (
            SetParametersAtomically,
            'set_parameters_atomically',
            SetParametersAtomically.Request(parameters=parameters),
        ),
        (ChangeState, 'change_state', change),
    ):
        asked, answered, bad = _ask(client, kind, f'{name}/{service}', request, times)
        died = int(process.poll() is not None)
        yield (
            *('hostile requests', name, asked, service, answered),
            *(asked - answered, len(bad), died),
        )
        if died:
            return
    for transition in (1, 3):  # configure and activate may each be refused
        change = ChangeState.Request()
        change.transition.id = transition
        client.call(ChangeState, f'{name}/change_state', transition=change.transition)
    state = client.call(GetState, f'{name}/get_state').current_state.label
    wrong = int(state != 'active')
    yield 'state after these', name, 1, state, 1, 0, wrong, int(process.poll() is not None)


def _ask(
    client: graph.Client, kind: Any, service: str, template: Any, times: int
) -> tuple[int, int, list[str]]:
    """Send mutant requests, a few at once; numbers of requests and answers, wrong answers."""
    from bench.hostile import not_finite, send_mutants

    caller = client.node.create_client(kind, service)
    client.until(caller.service_is_ready, service)
    asked = answered = 0
    bad: list[str] = []
    waiting: list[Any] = []

    def settle(most: int) -> bool:
        """Process answers until few requests are pending; False after the timeout."""
        nonlocal waiting, answered

        def few() -> bool:
            return sum(not future.done() for future in waiting) <= most

        in_time = client.holds(few, _ANSWER_S)
        done = [future for future in waiting if future.done()]
        waiting = [future for future in waiting if not future.done()]
        answered += len(done)
        for future in done:
            bad.extend(not_finite(future.result(), _MAY_BE_INFINITE))
        return in_time

    is_heard = True

    def ask(mutant: Any) -> None:
        nonlocal asked, is_heard
        # rclpy clients cannot send bytes; without answers, send no more.
        if isinstance(mutant, bytes) or not is_heard:
            return
        if hasattr(mutant, 'transition') and mutant.transition.id in _SHUTDOWNS:
            return
        if hasattr(mutant, 'dry_run'):
            mutant.dry_run = True
        asked += 1
        waiting.append(caller.call_async(mutant))
        is_heard = settle(_AT_ONCE - 1)

    series = 0
    while asked < times and is_heard:
        send_mutants(template, (times - asked) * 16 // 15 + 1, ask, series)
        series += 1
    settle(0)
    return asked, answered, bad


def _calibration(campaign: Campaign) -> Any:
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    return calibration_to_message(campaign.calibration, make_message)


def _finite(answers: list[Any], bad: list[str]) -> Callable[[Any], None]:
    """Collect the names of fields with non-finite numbers."""
    from bench.hostile import not_finite

    def take(message: Any) -> None:
        answers.append(message)
        bad.extend(not_finite(message, _MAY_BE_INFINITE))

    return take


def _hostile_to_calibrator(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import CameraInfo
    from std_srvs.srv import Trigger

    from starcal.msg import Calibration, EnsembleStatus
    from starcal.msg import StarObservations as Observations
    from starcal.srv import Calibrate

    bad: list[str] = []
    status: list[Any] = []
    name = 'calibrator'
    with campaign.running(name, 'max_images:=30') as process, graph.Client() as client:
        for kind, topic, taken in (
            (EnsembleStatus, 'ensemble_status', status),
            (Calibration, 'calibration', []),
            (Calibration, 'candidate_calibration', []),
            (CameraInfo, 'camera_info', []),
            (TransformStamped, 'alignment', []),
        ):
            client.collect(kind, topic, _finite(taken, bad), latched=True)
        count = _Taken(client, name)
        publisher = client.publisher(Observations, 'observations')
        template = campaign.message(_brightest(campaign.observations[0]))
        answered = _send(client, publisher, template, times, count, 700)
        died = int(process.poll() is not None)
        yield (
            *('hostile messages', name, times, 'observations', answered),
            *(max(0, times - answered), len(bad), died),
        )
        bad.clear()

        def collect(records: list[StarObservations]) -> bool:
            """Collect observations; return True if the ensemble holds exactly these."""
            client.call(Trigger, f'{name}/reset')
            client.holds(lambda: status and status[-1].images == 0)
            for record in records:
                publisher.publish(campaign.message(record))
            return client.holds(lambda: status and status[-1].images == len(records))

        # Few stars, so that valid requests are solved fast.
        wrong = int(not collect([_brightest(record) for record in campaign.observations]))
        request = Calibrate.Request(method='magic', estimate=['fx', 'fz'])
        asked, answered, found = _ask(client, Calibrate, f'{name}/solve', request, times)
        wrong += len(found)
        died = int(process.poll() is not None)
        yield (
            *('hostile requests', name, asked, 'solve', answered),
            *(asked - answered, wrong, died),
        )
        yield from _hostile_requests(client, process, name, times)
        wrong = int(not collect(campaign.observations))
        answer = client.call(Trigger, f'{name}/calibrate')
        client.holds(lambda: False, 0.5)  # its publications are checked too
        yield (
            *('a sound ensemble after these', name, 1, 'calibrate', int(answer.success)),
            *(int(not answer.success), wrong + len(bad), int(process.poll() is not None)),
        )


def _brightest(record: StarObservations) -> StarObservations:
    """The observations with the 40 brightest stars only."""
    return record.select(np.argsort(np.argsort(-record.flux_dn)) < 40)


def _killed(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    """Kill -9 at random during images and solves; all images reported as saved must persist."""
    from bench.kills import Flight

    choose = random.Random(2)
    with Flight(campaign, campaign.folder / 'state') as flight:
        for k in range(times):
            flight.fly(choose.uniform(0.1, 2.5))
            # One of them, or sometimes both at once; the short form kills each.
            names = (('calibrator',), ('star_observer',), flight.NODES)[k % 3]
            flight.kill(*names)
            if k % 5 == 3:
                flight.kill_at_start(names[0], choose.uniform(0.0, 3.0))
        flight.fly(0.5)
    for name in flight.NODES:
        yield (
            *('kill -9', name, flight.kills[name], f'kills, {flight.sent} images'),
            *(flight.reported if name == 'calibrator' else flight.answered, flight.lost[name]),
            *(flight.wrong[name], flight.died[name]),
        )
    damaged = len(list((campaign.folder / 'state').rglob('*.damaged')))
    what = f'state after {flight.numbers} active calibrations'
    yield 'kill -9', 'calibrator', 1, what, flight.reported, 0, damaged, 0


_ROOM = {
    'no room for the state': ('size=64k', 'size=16m', 'No space left on device'),
    'state that cannot be written': ('ro', 'rw', 'Read-only file system'),
}


def _no_room(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    """A full or read-only disk that recovers: kept in memory, reported, then saved."""
    if subprocess.run([*_OWN_MOUNTS, 'true'], capture_output=True, check=False).returncode:
        print('faults: no mounts allowed here: full and read-only disk left out', flush=True)
        return
    for fault, (bad, good, cause) in _ROOM.items():
        lost = wrong = died = images = 0
        for k in range(times):
            here = _without_room(campaign, f'{fault.split()[0]}{k}', bad, good, cause)
            lost, wrong, died = lost + here[0], wrong + here[1], died + here[2]
            images += len(campaign.observations)
        yield fault, 'calibrator', times, 'starts', images, lost, wrong, died


# A private mount of one process, removed when the process ends.
_OWN_MOUNTS = ('unshare', '--map-root-user', '--mount')
_MOUNTED = 'mount -t tmpfs -o "$1" tmpfs "$0" && shift && exec "$@"'


def _without_room(
    campaign: Campaign, name: str, bad: str, good: str, cause: str
) -> tuple[int, int, int]:
    """Return the numbers of images lost, answers wrong and nodes died."""
    from diagnostic_msgs.msg import DiagnosticArray
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus
    from starcal.msg import StarObservations as Observations

    folder = campaign.folder / name
    folder.mkdir()
    status: list[Any] = []
    health: list[Any] = []
    before = (*_OWN_MOUNTS, 'sh', '-c', _MOUNTED, str(folder), bad)
    with (
        campaign.running(
            'calibrator', f'state_dir:={folder}', node=name, before=before
        ) as process,
        graph.Client() as client,
    ):
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
        publisher = client.publisher(Observations, 'observations')
        for record in campaign.observations:
            publisher.publish(campaign.message(record))
        count = len(campaign.observations)
        client.holds(lambda: status and status[-1].images == count)
        wrong = int(status[-1].images != count) + int(status[-1].images_saved == count)
        answer = client.call(Trigger, f'{name}/calibrate')
        wrong += not (answer.success and 'not on disk' in answer.message)

        def said() -> bool:
            return any(
                one.status[0].level == b'\x02' and cause in one.status[0].message for one in health
            )

        wrong += not client.holds(said)
        inside = ('nsenter', f'--target={process.pid}', '--user', '--mount')
        remount = (*inside, '--preserve-credentials', 'mount', '-o', f'remount,{good}')
        subprocess.run([*remount, str(folder)], check=True)
        client.holds(lambda: status[-1].images_saved == count)
        health.clear()
        # A warning about the report may remain until the next calibration writes it again.
        wrong += not client.holds(lambda: health and health[-1].status[0].level < b'\x02')
        # Read it as a restart would, through the mounts of the process.
        copy = campaign.folder / f'{name}_copy'
        shutil.copytree(Path(f'/proc/{process.pid}/root{folder}'), copy)
        archive = Archive(copy, 'camera')
        lost = count - len(archive.read_ensemble().images)
        wrong += len(archive.read_history()) != 1
        archive.close()
        return lost, wrong, int(process.poll() is not None)


def _many_callers(campaign: Campaign, times: int) -> Iterator[tuple[Any, ...]]:
    """Concurrent clients, one that exits before its answer, and a second calibrator."""
    from diagnostic_msgs.msg import DiagnosticArray
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus
    from starcal.msg import StarObservations as Observations

    with campaign.running('calibrator') as process, graph.Client() as client:
        status: list[Any] = []
        health: list[Any] = []
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
        publisher = client.publisher(Observations, 'observations')
        for record in campaign.observations:
            publisher.publish(campaign.message(record))
        client.holds(lambda: status and status[-1].images == 10)
        callers = [
            client.node.create_client(Trigger, 'calibrator/calibrate') for _ in range(times)
        ]
        client.until(lambda: all(one.service_is_ready() for one in callers), 'calibrate')
        futures = [one.call_async(Trigger.Request()) for one in callers]
        client.holds(lambda: all(future.done() for future in futures), _ANSWER_S)
        done = [future for future in futures if future.done()]
        wrong = sum(not future.result().success for future in done)
        died = int(process.poll() is not None)
        yield (
            *('calls at once', 'calibrator', times, '~/calibrate', len(done)),
            *(times - len(done), wrong, died),
        )

        caller = subprocess.Popen([sys.executable, '-c', _CALLER], stdout=subprocess.PIPE)
        assert caller.stdout is not None
        caller.stdout.readline()
        caller.kill()
        caller.wait()
        answer = client.call(Trigger, 'calibrator/calibrate')
        died = int(process.poll() is not None)
        yield 'caller killed', 'calibrator', 1, '~/calibrate', 1, int(not answer.success), 0, died

        with campaign.running('calibrator', node='double'):
            warned = client.holds(
                lambda: any(
                    'another node publishes' in one.status[0].message for one in health[-4:]
                )
            )
        answer = client.call(Trigger, 'calibrator/calibrate')
        died = int(process.poll() is not None)
        yield (
            *('a second calibrator', 'calibrator', 1, 'diagnostics warn', int(warned)),
            *(int(not warned), int(not answer.success), died),
        )


_CALLER = """
import time, rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node('caller')
client = node.create_client(Trigger, 'calibrator/calibrate')
client.wait_for_service()
client.call_async(Trigger.Request())
print('called', flush=True)
time.sleep(60)
"""
