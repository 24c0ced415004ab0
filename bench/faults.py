"""
Faults on the real graph: hostile messages, kills, full disks, doubles, callers that go, bad bags.

Each row says how often a fault was made and what it did: what was lost, what was wrong, which node
died.  All three must be 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import functools
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
from bench.frames import history, render_frame, write_set_up
from bench.table import Table
from starcal_ros.bag import reader
from starcal_ros.calibrator.archive import Archive
from starcal_ros.errors import BagError
from starcal_ros.messages.calibration import calibration_to_message
from starcal_ros.messages.fields import make_header
from starcal_ros.messages.images import image_to_message
from starcal_ros.messages.observations import observations_to_message
from starcal_ros.messages.telemetry import attitude_to_message
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline import observe, solve
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.simulation import bag as simulated_bag
from starcal_ros.simulation import scenario

COLUMNS = ('fault', 'node', 'times', 'what', 'answered', 'lost', 'wrong', 'died')
_ANSWER_S = 60.0
# What the documents allow: not known, not observable, and no number.
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
    """Make every fault a few times, or as often as the requirements ask."""
    if not importlib.util.find_spec('rclpy'):
        print('faults: no rclpy here: left out\n')
        return []
    graph.own_domain()
    table = Table('Faults: lost, wrong and died must be 0', COLUMNS)
    with tempfile.TemporaryDirectory() as folder:
        bench = _Bench(Path(folder))
        for fault, quick_times, times in (
            (_damaged_bags, 40, 5000),
            (_hostile_to_observer, 20, 10_000),
            (_hostile_to_calibrator, 20, 10_000),
            (_killed, 2, 50),
            (_no_room, 1, 5),
            (_many_callers, 10, 10),
        ):
            for row in fault(bench, quick_times if quick else times):
                table.add(*row)
                print('faults:', *row, flush=True)
    print()
    print(table.text())
    return [table]


class _Bench:
    """Ten small frames, their observations and their calibration, and where nodes find them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
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
        ensemble = functools.reduce(Ensemble.add, self.observations, Ensemble())
        self.calibration = solve.solve(ensemble, self.setup)

    def message(self, record: StarObservations, time_ns: int | None = None) -> Any:
        """Observations as a message, with another stamp where one is given."""
        from starcal_ros.nodes.message_factory import make_message

        message = observations_to_message(record, 'camera', make_message)
        if time_ns is not None:
            message.header = make_header(time_ns, 'camera', make_message)
        return message

    def running(self, name: str, *values: str, **options: Any) -> Any:
        """A node process for a ``with`` statement."""
        return graph.running(name, self.params, self.log, *values, **options)


def _damaged_bags(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    """Bits flipped and ends cut off: what is read was written, what is missing is said."""
    folder = bench.folder / 'bag'
    simulated_bag.write_bag(bench.scenario, folder)
    whole = next(folder.glob('*.mcap')).read_bytes()
    sound = list(reader.read_raw([folder]))
    choose = random.Random(1)
    silent = wrong = failed = 0
    file = bench.folder / 'damaged.mcap'
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


def _hostile_to_observer(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    from geometry_msgs.msg import QuaternionStamped, TwistStamped
    from sensor_msgs.msg import CompressedImage, Image, Temperature

    from starcal.msg import Calibration
    from starcal_ros.nodes.message_factory import make_message

    image, samples = bench.frames[0]
    small = image_to_message(image, 'camera', make_message)
    small.height, small.width, small.step, small.data = 4, 4, 8, bytes(32)
    attitude = attitude_to_message(
        image.time_ns, samples[1].icrf_from_star_tracker_xyzw, 'icrf', make_message
    )
    others: list[tuple[Any, str, Any]] = [
        (QuaternionStamped, 'attitude', attitude),
        (TwistStamped, 'velocity', TwistStamped(header=small.header)),
        (Temperature, 'temperature', Temperature(header=small.header)),
        (Calibration, 'calibration', _calibration(bench)),
    ]
    yield from _hostile(bench, [(Image, 'image', small), *others], times)
    png = CompressedImage(header=small.header, format='mono16; png compressed')
    png.data = _png(image.pixels[:4, :4])
    compressed = [(CompressedImage, 'image/compressed', png)]
    yield from _hostile(bench, compressed, times, 'image_transport:=compressed')


def _png(pixels: Any) -> bytes:
    return cv2.imencode('.png', pixels)[1].tobytes()


def _hostile(
    bench: _Bench, inputs: list[tuple[Any, str, Any]], times: int, *more: str
) -> Iterator[tuple[Any, ...]]:
    """Mutants on inputs and services of a star observer; then a sound image must be measured."""
    from sensor_msgs.msg import CameraInfo

    from starcal.msg import StarObservations

    answers: list[Any] = []
    bad: list[str] = []
    name = 'star_observer'
    values = ('attitude_timeout_s:=0.0', 'image_queue:=1000', 'camera_info_per_image:=true')
    with bench.running(name, *values, *more) as process, graph.Client() as client:
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
                # Of a latched topic the reader holds one: each waits until the node is through.
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
        used = _measures_a_sound_image(bench, client, answers, inputs[0][1])
        yield (
            *('a sound image after these', name, 1, inputs[0][1], int(used)),
            *(int(not used), len(bad), int(process.poll() is not None)),
        )


def _measures_a_sound_image(
    bench: _Bench, client: graph.Client, answers: list[Any], topic: str
) -> bool:
    """Whether one of five sound images, far ahead of all that was sent, gives its stars."""
    from geometry_msgs.msg import QuaternionStamped
    from sensor_msgs.msg import CompressedImage, Image

    from starcal.msg import Calibration
    from starcal_ros.nodes.message_factory import make_message

    client.publisher(Calibration, 'calibration', latched=True).publish(_calibration(bench))
    attitudes = client.publisher(QuaternionStamped, 'attitude')
    images = client.publisher(Image if topic == 'image' else CompressedImage, topic)
    image, samples = bench.frames[0]
    message = image_to_message(image, 'camera', make_message)
    if topic != 'image':
        message = CompressedImage(format='mono16; png compressed', data=_png(image.pixels))
    stars = set(bench.observations[0].catalog_id.tolist())
    for k in range(1, 6):  # the first ones may come before their attitude
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
        # Some of them stand at the limit, which is found anew.
        if len(stars & set(answers[-1].catalog_id)) > 0.9 * len(stars):
            return True
    return False


class _Taken:
    """How many messages a node says that it has taken, and what else its diagnostics say."""

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
        """Messages taken; up to a second old."""
        return int(self._values['messages'])

    def pass_through(self) -> None:
        """Wait until the node has answered one call: it looked at what came before."""
        future = self._state.call_async(self._ask)
        self._client.until(future.done, 'get_state')

    def _take(self, message: Any) -> None:
        status = message.status[0]
        if status.name == self._name:
            self._values = {value.key: value.value for value in status.values}


def _send_images(
    client: graph.Client, publisher: Any, template: Any, times: int, answers: list[Any]
) -> int:
    """Publish mutants no faster than they are answered; how many of them a reader can decode."""
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
    Publish mutants until the node has taken so many; how many it has.

    A reader that holds ``held`` messages loses none: no more than that are under way.
    """
    from rclpy.serialization import deserialize_message

    from bench.hostile import send_mutants

    before, sent = taken(), 0

    def send(mutant: Any) -> None:
        nonlocal sent
        publisher.publish(mutant)
        sent += _can_be_decoded(mutant, type(template), deserialize_message)
        if held == 1:
            taken.pass_through()  # at once; its acknowledgement comes with a heartbeat only
        else:
            client.holds(lambda: sent - (taken() - before) < held, _ANSWER_S)

    for series in range(20):  # those that cannot be decoded are made up for
        missing = times - (taken() - before)
        if missing <= 0:
            break
        send_mutants(template, missing + missing // 10 + 2, send, series)
        client.holds(lambda: taken() - before >= sent, 3.0)  # the diagnostics come every second
    return taken() - before


def _can_be_decoded(mutant: Any, kind: Any, deserialize: Callable[[bytes, Any], Any]) -> bool:
    if not isinstance(mutant, bytes):
        return True
    try:
        deserialize(mutant, kind)
    except Exception:
        return False
    return True


_AT_ONCE = 8  # requests under way
_SHUTDOWNS = (5, 6, 7)  # which a node is right to obey


def _hostile_requests(
    client: graph.Client, process: Any, name: str, times: int
) -> Iterator[tuple[Any, ...]]:
    """Mutants of the requests that every node answers; it is active again afterwards."""
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
    for transition in (1, 3):  # configure, activate: one of them or both may be refused
        change = ChangeState.Request()
        change.transition.id = transition
        client.call(ChangeState, f'{name}/change_state', transition=change.transition)
    state = client.call(GetState, f'{name}/get_state').current_state.label
    wrong = int(state != 'active')
    yield 'state after these', name, 1, state, 1, 0, wrong, int(process.poll() is not None)


def _ask(
    client: graph.Client, kind: Any, service: str, template: Any, times: int
) -> tuple[int, int, list[str]]:
    """Ask with mutants, a few at once; how often, how many were answered, what was wrong."""
    from bench.hostile import not_finite, send_mutants

    caller = client.node.create_client(kind, service)
    client.until(caller.service_is_ready, service)
    asked = answered = 0
    bad: list[str] = []
    waiting: list[Any] = []

    def settle(most: int) -> bool:
        """Take answers until no more than so many are waited for; whether that came to be."""
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
        # A client of rclpy sends no bytes; and where nobody answers no more is asked.
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


def _calibration(bench: _Bench) -> Any:
    from starcal_ros.nodes.message_factory import make_message

    return calibration_to_message(bench.calibration, make_message)


def _finite(answers: list[Any], bad: list[str]) -> Callable[[Any], None]:
    """Take messages, and note which of their numbers are not finite."""
    from bench.hostile import not_finite

    def take(message: Any) -> None:
        answers.append(message)
        bad.extend(not_finite(message, _MAY_BE_INFINITE))

    return take


def _hostile_to_calibrator(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    from geometry_msgs.msg import TransformStamped
    from sensor_msgs.msg import CameraInfo
    from std_srvs.srv import Trigger

    from starcal.msg import Calibration, EnsembleStatus
    from starcal.msg import StarObservations as Observations
    from starcal.srv import Calibrate

    bad: list[str] = []
    status: list[Any] = []
    name = 'calibrator'
    with bench.running(name, 'max_images:=30') as process, graph.Client() as client:
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
        template = bench.message(_brightest(bench.observations[0]))
        answered = _send(client, publisher, template, times, count, 700)
        died = int(process.poll() is not None)
        yield (
            *('hostile messages', name, times, 'observations', answered),
            *(max(0, times - answered), len(bad), died),
        )
        bad.clear()

        def collect(records: list[StarObservations]) -> bool:
            """Whether the ensemble is made of these alone."""
            client.call(Trigger, f'{name}/reset')
            client.holds(lambda: status and status[-1].images == 0)
            for record in records:
                publisher.publish(bench.message(record))
            return client.holds(lambda: status and status[-1].images == len(records))

        # Few stars: what is asked for is solved where the request is sound.
        wrong = int(not collect([_brightest(record) for record in bench.observations]))
        request = Calibrate.Request(method='magic', estimate=['fx', 'fz'])
        asked, answered, found = _ask(client, Calibrate, f'{name}/solve', request, times)
        wrong += len(found)
        died = int(process.poll() is not None)
        yield (
            *('hostile requests', name, asked, 'solve', answered),
            *(asked - answered, wrong, died),
        )
        yield from _hostile_requests(client, process, name, times)
        wrong = int(not collect(bench.observations))
        answer = client.call(Trigger, f'{name}/calibrate')
        client.holds(lambda: False, 0.5)  # what it publishes is checked too
        yield (
            *('a sound ensemble after these', name, 1, 'calibrate', int(answer.success)),
            *(int(not answer.success), wrong + len(bad), int(process.poll() is not None)),
        )


def _brightest(record: StarObservations) -> StarObservations:
    """The same image with its 40 brightest stars."""
    return record.select(np.argsort(np.argsort(-record.flux_dn)) < 40)


def _killed(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    """Kill -9 at random while images flow and solves run; what was told as kept must be there."""
    from bench.kills import Flight

    choose = random.Random(2)
    with Flight(bench, bench.folder / 'state') as flight:
        for k in range(times):
            flight.fly(choose.uniform(0.1, 2.5))
            # Either, or now and then both at once; the short form kills each.
            names = (('calibrator',), ('star_observer',), flight.NODES)[k % 3]
            flight.kill(*names)
            if k % 5 == 3:
                flight.kill_at_start(names[0], choose.uniform(0.0, 3.0))
        flight.fly(0.5)
    for name in flight.NODES:
        yield (
            *('kill -9', name, flight.kills[name], f'kills, {flight.sent} images'),
            *(flight.told if name == 'calibrator' else flight.answered, flight.lost[name]),
            *(flight.wrong[name], flight.died[name]),
        )
    damaged = len(list((bench.folder / 'state').rglob('*.damaged')))
    what = f'state after {flight.numbers} calibrations in force'
    yield 'kill -9', 'calibrator', 1, what, flight.told, 0, damaged, 0


_ROOM = {
    'no room for the state': ('size=64k', 'size=16m', 'No space left on device'),
    'state that cannot be written': ('ro', 'rw', 'Read-only file system'),
}


def _no_room(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    """A disk that is full or read-only, and later not: collected in memory, said, then saved."""
    if subprocess.run([*_OWN_MOUNTS, 'true'], capture_output=True, check=False).returncode:
        print('faults: no mounts allowed here: full and read-only disk left out', flush=True)
        return
    for fault, (bad, good, cause) in _ROOM.items():
        lost = wrong = died = images = 0
        for k in range(times):
            here = _without_room(bench, f'{fault.split()[0]}{k}', bad, good, cause)
            lost, wrong, died = lost + here[0], wrong + here[1], died + here[2]
            images += len(bench.observations)
        yield fault, 'calibrator', times, 'starts', images, lost, wrong, died


# A disk of its own for one process: no other sees it, and it goes when the process ends.
_OWN_MOUNTS = ('unshare', '--map-root-user', '--mount')
_MOUNTED = 'mount -t tmpfs -o "$1" tmpfs "$0" && shift && exec "$@"'


def _without_room(
    bench: _Bench, name: str, bad: str, good: str, cause: str
) -> tuple[int, int, int]:
    """Images lost, answers wrong, nodes died."""
    from diagnostic_msgs.msg import DiagnosticArray
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus
    from starcal.msg import StarObservations as Observations

    folder = bench.folder / name
    folder.mkdir()
    status: list[Any] = []
    health: list[Any] = []
    before = (*_OWN_MOUNTS, 'sh', '-c', _MOUNTED, str(folder), bad)
    with (
        bench.running('calibrator', f'state_dir:={folder}', node=name, before=before) as process,
        graph.Client() as client,
    ):
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
        publisher = client.publisher(Observations, 'observations')
        for record in bench.observations:
            publisher.publish(bench.message(record))
        count = len(bench.observations)
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
        # A warning may stay: of the report, which the next calibration writes again.
        wrong += not client.holds(lambda: health and health[-1].status[0].level < b'\x02')
        # As a restart would read it, through the mounts of the process.
        copy = bench.folder / f'{name}_copy'
        shutil.copytree(Path(f'/proc/{process.pid}/root{folder}'), copy)
        archive = Archive(copy, 'camera')
        lost = count - len(archive.read_ensemble().images)
        wrong += len(archive.read_history()) != 1
        archive.close()
        return lost, wrong, int(process.poll() is not None)


def _many_callers(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    """Callers at once, one that goes before its answer, and a second calibrator on the graph."""
    from diagnostic_msgs.msg import DiagnosticArray
    from std_srvs.srv import Trigger

    from starcal.msg import EnsembleStatus
    from starcal.msg import StarObservations as Observations

    with bench.running('calibrator') as process, graph.Client() as client:
        status: list[Any] = []
        health: list[Any] = []
        client.collect(EnsembleStatus, 'ensemble_status', status.append, latched=True)
        client.collect(DiagnosticArray, '/diagnostics', health.append, latched=False)
        publisher = client.publisher(Observations, 'observations')
        for record in bench.observations:
            publisher.publish(bench.message(record))
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

        with bench.running('calibrator', node='double'):
            warned = client.holds(
                lambda: any('another publisher' in one.status[0].message for one in health[-4:])
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
