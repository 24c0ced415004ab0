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

from bench import graph
from bench.frames import history, render_frame, write_set_up
from bench.table import Table
from starcal_ros import bag, sequence, simulation, solution, synthetic
from starcal_ros.archive import Archive
from starcal_ros.calibration_messages import calibration_to_message
from starcal_ros.camera_setup import load_setup
from starcal_ros.errors import BagError
from starcal_ros.image_messages import image_to_message
from starcal_ros.message_fields import make_header
from starcal_ros.observation_messages import observations_to_message
from starcal_ros.options import read_parameter_file
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.telemetry_messages import attitude_to_message

COLUMNS = ('fault', 'node', 'times', 'what', 'answered', 'lost', 'wrong', 'died')
_ANSWER_S = 60.0
# What the documents allow: not known, and not observable.
_MAY_BE_INFINITE = frozenset(
    ['temperature_degc', 'reference_temperature_degc', 'predicted_sigma', 'attitude_gap_s']
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
        self.scenario = synthetic.scenario('tiny')
        self.params = write_set_up(self.scenario, folder)
        self.log = folder / 'log'
        self.frames = [render_frame(self.scenario, index) for index in range(10)]
        self.setup = load_setup(read_parameter_file(self.params, ()))
        self.observations: list[StarObservations] = []
        track = sequence.Track(self.setup.prior)
        for image, samples in self.frames:
            found, track = sequence.observe_next(image, history(samples), self.setup, track)
            self.observations.append(found)
        ensemble = functools.reduce(Ensemble.add, self.observations, Ensemble())
        self.calibration = solution.solve(ensemble, self.setup)

    def message(self, record: StarObservations, time_ns: int | None = None) -> Any:
        """Observations as a message, with another stamp where one is given."""
        from starcal_ros.nodes.conversions import make_message

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
    simulation.write_bag(bench.scenario, folder)
    whole = next(folder.glob('*.mcap')).read_bytes()
    sound = list(bag.read_raw([folder]))
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
            read = list(bag.read_raw([file], on_damage=said.append))
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

    from starcal.msg import Calibration, StarObservations
    from starcal_ros.nodes.conversions import make_message

    image, samples = bench.frames[0]
    small = image_to_message(image, 'camera', make_message)
    small.height, small.width, small.step, small.data = 4, 4, 8, bytes(32)
    attitude = attitude_to_message(
        image.time_ns, samples[1].icrf_from_star_tracker_xyzw, 'icrf', make_message
    )
    inputs: list[tuple[Any, str, Any]] = [
        (Image, 'image', small),
        (QuaternionStamped, 'attitude', attitude),
        (TwistStamped, 'velocity', TwistStamped(header=small.header)),
        (Temperature, 'temperature', Temperature(header=small.header)),
        (Calibration, 'calibration', _calibration(bench)),
    ]
    yield from _hostile(bench, 'star_observer', inputs, StarObservations, times)
    png = CompressedImage(header=small.header, format='mono16; png compressed', data=bytes(64))
    inputs = [(CompressedImage, 'image/compressed', png)]
    values = ('image_transport:=compressed',)
    yield from _hostile(bench, 'star_observer', inputs, StarObservations, times, *values)


def _hostile(
    bench: _Bench,
    name: str,
    inputs: list[tuple[Any, str, Any]],
    answer: Any,
    times: int,
    *more: str,
) -> Iterator[tuple[Any, ...]]:
    """Mutants on every input of a star observer; then a sound image must be measured."""
    from lifecycle_msgs.srv import GetState

    answers: list[Any] = []
    bad: list[str] = []
    values = ('attitude_timeout_s:=0.0', 'image_queue:=1000', *more)
    with bench.running(name, *values) as process, graph.Client() as client:
        client.collect(answer, 'observations', _finite(answers, bad), latched=False)
        for kind, topic, template in inputs:
            is_image = topic.startswith('image')
            publisher = client.publisher(kind, topic, latched=topic == 'calibration')
            before, bad_before = len(answers), len(bad)
            sent = _send(client, publisher, template, times, is_image, answers)
            died = process.poll() is not None
            answered = len(answers) - before if is_image else sent
            yield (
                *('hostile messages', name, times, topic, answered),
                *(sent - answered, len(bad) - bad_before, int(died)),
            )
            if died:
                return
        assert client.call(GetState, f'{name}/get_state').current_state.label == 'active'
        if not more:
            used = _measures_a_sound_image(bench, client, answers)
            yield 'a sound image after these', name, 1, 'image', int(used), int(not used), 0, 0


def _measures_a_sound_image(bench: _Bench, client: graph.Client, answers: list[Any]) -> bool:
    """Whether the node gives the stars of an image of a later time."""
    from geometry_msgs.msg import QuaternionStamped
    from sensor_msgs.msg import Image

    from starcal.msg import Calibration
    from starcal_ros.nodes.conversions import make_message

    client.publisher(Calibration, 'calibration', latched=True).publish(_calibration(bench))
    attitudes = client.publisher(QuaternionStamped, 'attitude')
    images = client.publisher(Image, 'image')
    image, samples = bench.frames[0]
    message = image_to_message(image, 'camera', make_message)
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
        if len(answers) > before and not answers[-1].refusal:
            return True
    return False


def _send(
    client: graph.Client,
    publisher: Any,
    template: Any,
    times: int,
    is_image: bool,
    answers: list[Any],
) -> int:
    """Publish mutants no faster than they are taken; how many of them a reader can decode."""
    from rclpy.duration import Duration
    from rclpy.serialization import deserialize_message

    from bench.hostile import send_mutants

    before, count, sent = len(answers), 0, 0

    def send(mutant: Any) -> None:
        nonlocal count, sent
        count += 1
        if isinstance(mutant, bytes):
            try:
                deserialize_message(mutant, type(template))
            except Exception:
                sent -= 1
        sent += 1
        publisher.publish(mutant)
        if is_image:
            client.holds(lambda: sent - (len(answers) - before) < 100, _ANSWER_S)
        elif count % 200 == 0:
            publisher.wait_for_all_acked(Duration(seconds=30))

    send_mutants(template, times, send)
    if is_image:
        client.holds(lambda: len(answers) - before >= sent, _ANSWER_S)
    publisher.wait_for_all_acked(Duration(seconds=30))
    return sent


def _calibration(bench: _Bench) -> Any:
    from starcal_ros.nodes.conversions import make_message

    return calibration_to_message(bench.calibration, make_message)


def _finite(answers: list[Any], bad: list[str]) -> Callable[[Any], None]:
    """Take messages, and note which of their numbers are not finite."""
    from bench.hostile import not_finite

    def take(message: Any) -> None:
        answers.append(message)
        bad.extend(not_finite(message, _MAY_BE_INFINITE))

    return take


def _hostile_to_calibrator(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    from bench.hostile import not_finite, send_mutants
    from starcal.msg import Calibration, EnsembleStatus
    from starcal.msg import StarObservations as Observations
    from starcal.srv import Calibrate

    bad: list[str] = []
    taken: list[Any] = []
    with bench.running('calibrator', 'max_images:=30') as process, graph.Client() as client:
        for kind, topic in (
            (EnsembleStatus, 'ensemble_status'),
            (Calibration, 'calibration'),
            (Calibration, 'candidate_calibration'),
        ):
            client.collect(kind, topic, _finite(taken, bad), latched=True)
        publisher = client.publisher(Observations, 'observations')
        template = bench.message(bench.observations[0])
        _send(client, publisher, template, times, False, [])
        for k, record in enumerate(bench.observations):
            publisher.publish(bench.message(record, (k + 1) * 10**9))
        solved = client.call(Calibrate, 'calibrator/solve', _ANSWER_S, dry_run=True)
        bad += not_finite(solved, _MAY_BE_INFINITE)
        died = int(process.poll() is not None)
        yield 'hostile messages', 'calibrator', times, 'observations', times, 0, len(bad), died

        bad.clear()
        solve = client.node.create_client(Calibrate, 'calibrator/solve')
        client.until(solve.service_is_ready, 'solve')
        answered = sent = 0

        def ask(mutant: Any) -> None:
            nonlocal answered, sent
            if isinstance(mutant, bytes):
                return
            sent += 1
            mutant.dry_run = True
            future = solve.call_async(mutant)
            if client.holds(future.done, _ANSWER_S):
                answered += 1
                bad.extend(not_finite(future.result(), _MAY_BE_INFINITE))

        send_mutants(Calibrate.Request(method='magic', estimate=['fx', 'fz']), times // 2, ask)
        died = int(process.poll() is not None)
        yield (
            'hostile requests',
            'calibrator',
            sent,
            '~/solve',
            answered,
            sent - answered,
            len(bad),
            died,
        )


def _killed(bench: _Bench, times: int) -> Iterator[tuple[Any, ...]]:
    """Kill -9 at random while images flow and solves run; what was told as kept must be there."""
    from bench.kills import Flight

    choose = random.Random(2)
    with Flight(bench, bench.folder / 'state') as flight:
        for k in range(times):
            flight.fly(choose.uniform(0.1, 2.5))
            # Either, or now and then both at once; the short form kills each.
            flight.kill(*(('calibrator',), ('star_observer',), flight.NODES)[k % 3])
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
