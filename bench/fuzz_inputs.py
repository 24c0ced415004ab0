# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Hypothesis on text and messages from outside: ``python -m bench.fuzz_inputs KIND COUNT [SECONDS]``.

Each kind starts from a sound input.  A case replaces, doubles, cuts or spoils parts of it.  It
fails with an exception that is no `StarcalError`, an error text of several lines, or more than
`SLOW_S` of processor time; nothing here waits for anything.  The process prints one JSON object.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import hashlib
import itertools
import json
import math
from pathlib import Path
import re
import resource
import shutil
import sys
import tempfile
import time
from typing import Any

from hypothesis import given, HealthCheck, seed, settings
from hypothesis import strategies as st
import numpy as np

from bench.frames import write_set_up
from starcal_ros.assessment.comparison import compare
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.bag import reader
from starcal_ros.bag.writer import BagWriter
from starcal_ros.calibrator.archive import Activation, Archive
from starcal_ros.camera import field_radius_rad, line_of_sight, pixel_grid, project
from starcal_ros.camera_conversion import ros_fit
from starcal_ros.errors import StarcalError
from starcal_ros.options import read_parameter_file
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.node_options import NODE_OPTION_CLASSES
from starcal_ros.pipeline.setup import load_setup, NODES, Setup
from starcal_ros.products.calibration_json import (
    CALIBRATION_FILE,
    prior_of,
    read_calibration,
    write_calibration,
)
from starcal_ros.products.camera_yaml import read_camera_info
from starcal_ros.records import Calibration, Ensemble, Image
from starcal_ros.simulation import scenario as synthetic
from starcal_ros.simulation.centroids import true_observations

SLOW_S = 5.0
_ROUND = 250  # cases of one run of hypothesis, which slows down with their number
KINDS = ('parameters', 'camera', 'metadata', 'calibration', 'state', 'observations')

# Values that have been a traceback, a hang or a wrong number somewhere.
_TOKENS = (
    '', 'null', '~', 'true', 'yes', '0', '-0.0', '-1', '1e-6', '1e300', '-1e300', '1e999', '.nan',
    '.inf', 'NaN', 'Infinity', '2026-13-01', '2026-01-01', '12:30:45', '0x7fffffffffffffffff',
    '9' * 25, '9' * 5000, '-' + '9' * 5000, '0.' + '1' * 5000, '[]', '{}', '[[], {}]', '[' * 60,
    '{"a": ' * 60, '[' * 3000 + ']' * 3000, '"\\0"', '"\\u0000"', '"\\ud800"', '"\\udfff x"', '"',
    "'", '!!python/object/apply:os.system [x]', '!!binary aGk=', '!!int 3.5', '&a [*a]', '*a',
    '&a 1', '<<: 1', '? 1', '- 1', '|', '>', '%TAG ! x', '---', '...', '# x', '\t', '\x00',
    '\x1b[2J', 'a' * 5000, '/' * 3000, '../../etc/passwd', '\N{MINUS SIGN}1', '1' + '\u0301',
    'file:///dev/zero',
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Fuzzed:
    """Cases of a kind: how many were read, failed, and what the worst took."""

    kind: str
    tried: int
    read: int
    failures: tuple[str, ...]
    slowest_s: float
    peak_mb: float


@dataclasses.dataclass(frozen=True)
class _Kind:
    """``cases`` are the inputs; ``take`` reads one, and raises StarcalError to refuse it."""

    cases: st.SearchStrategy[Any]
    take: Callable[[Any], None]


@st.composite
def spoilt_text(draw: st.DrawFn, base: str) -> bytes:
    """A text file with up to three lines, values or runs of bytes changed."""
    lines = base.split('\n')
    token = st.one_of(
        st.sampled_from(_TOKENS),
        st.text(max_size=30),
        st.integers().map(str),
        st.floats().map(repr),
        st.floats(-100, 100).map(repr),
    )
    for _ in range(draw(st.sampled_from([1, 1, 2, 3]))):
        k = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(['value', 'number', 'key', 'double', 'drop', 'insert', 'join']))
        if how == 'value':
            comma = ',' if lines[k].endswith(',') else ''  # of JSON
            lines[k] = f'{lines[k].partition(": ")[0]}: {draw(token)}{comma}'
        elif how == 'number':
            numbers = list(re.finditer(r'-?\d[\d.e+-]*', lines[k]))
            if numbers:
                found = numbers[draw(st.integers(0, len(numbers) - 1))]
                lines[k] = lines[k][: found.start()] + draw(token) + lines[k][found.end() :]
        elif how == 'key':
            lines[k] = f'{draw(token)}: {lines[k].partition(": ")[2]}'
        elif how == 'double':
            lines.insert(k, lines[draw(st.integers(0, len(lines) - 1))])
        elif how == 'drop' and len(lines) > 1:
            del lines[k]
        elif how == 'insert':
            lines.insert(k, draw(token))
        else:
            lines[k] = lines[k] + draw(token)
    content = bytearray('\n'.join(lines).encode(errors='surrogatepass'))
    if draw(st.integers(0, 7)) == 0:
        del content[draw(st.integers(0, len(content))) :]
    if content and draw(st.integers(0, 7)) == 0:
        content[draw(st.integers(0, len(content) - 1))] = draw(st.integers(0, 255))
    return bytes(content)


def fuzz(name: str, count: int, folder: Path, seconds: float = math.inf) -> Fuzzed:
    """Run cases of a kind in a folder, fewer where the time does not suffice."""
    end_s = time.monotonic() + seconds
    kind = _kind(name, folder)
    tried = read = 0
    slowest_s = 0.0
    failures: list[str] = []

    def one(case: Any) -> None:
        nonlocal tried, read, slowest_s
        tried += 1
        start_s = time.process_time()
        try:
            kind.take(case)
            read += 1
        except StarcalError as error:
            if len(str(error).splitlines()) > 1 or len(str(error)) > 5000:
                failures.append(f'error of several lines: {error!r:.200}')
        except Exception as error:
            where = error.__traceback__
            while where is not None and where.tb_next is not None:
                where = where.tb_next
            place = f'{where.tb_frame.f_code.co_filename}:{where.tb_lineno}' if where else ''
            failures.append(f'{type(error).__name__}: {error!s:.200} at {place}; {case!r:.300}')
        took_s = time.process_time() - start_s
        slowest_s = max(slowest_s, took_s)
        if took_s > SLOW_S:
            failures.append(f'{took_s:.1f} s: {case!r:.300}')

    for number in itertools.count():  # hypothesis stops early without new examples
        if tried >= count or time.monotonic() > end_s:
            break

        @seed(number)
        @settings(
            max_examples=min(_ROUND, count - tried),
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(kind.cases)
        def draw(case: Any) -> None:
            if tried < count:
                one(case)

        draw()
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
    return Fuzzed(name, tried, read, tuple(failures), slowest_s, peak_mb)


def _kind(name: str, folder: Path) -> _Kind:
    scenario = synthetic.scenario('tiny')
    params = write_set_up(scenario, folder)
    if name == 'parameters':
        return _parameters(params)
    if name == 'camera':
        return _camera(folder / 'camera.yaml')
    if name == 'metadata':
        return _metadata(folder / 'bag')
    setup = load_setup(read_parameter_file(params, NODES), NODE_OPTION_CLASSES)
    ensemble = true_observations(scenario)
    if name == 'observations':
        return _observations(ensemble, setup)
    calibration = solve.solve(ensemble, setup)
    if name == 'calibration':
        return _calibration(calibration, folder)
    return _state(calibration, ensemble, folder / 'state')


def _parameters(path: Path) -> _Kind:
    prior = load_setup(read_parameter_file(path, NODES), NODE_OPTION_CLASSES).prior
    values = read_parameter_file(path, NODES)
    setup = load_setup(values, NODE_OPTION_CLASSES, prior)
    lines = [f'    {name}: {_flow(value)}' for name, value in setup.options().items()]
    base = '\n'.join(['/**:', '  ros__parameters:', *lines])

    def take(content: bytes) -> None:
        path.write_bytes(content)
        found = read_parameter_file(path, NODES)
        load_setup(found, NODE_OPTION_CLASSES, prior)

    return _Kind(spoilt_text(base), take)


def _flow(value: object) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value)


def _camera(path: Path) -> _Kind:
    def take(content: bytes) -> None:
        path.write_bytes(content)
        camera = read_camera_info(path)
        with np.errstate(all='ignore'):
            project(camera, line_of_sight(camera, pixel_grid(camera, 5, 5)))
            field_radius_rad(camera)
            ros_fit(camera)

    return _Kind(spoilt_text(path.read_text()), take)


def _metadata(folder: Path) -> _Kind:
    with BagWriter(folder) as writer:
        for k in range(3):
            writer.write_image('/image', Image(k, np.zeros((2, 2), np.uint8)), '')
    path = folder / 'metadata.yaml'

    def take(content: bytes) -> None:
        path.write_bytes(content)
        if [topic.count for topic in reader.topics([folder])] != [3]:
            raise AssertionError('another bag was read')

    return _Kind(spoilt_text(path.read_text()), take)


def _calibration(sound: Calibration, folder: Path) -> _Kind:
    path = folder / CALIBRATION_FILE
    write_calibration(sound, path)

    def take(content: bytes) -> None:
        path.write_bytes(content)
        found = read_calibration(path)
        prior_of(found)
        if found.accepted or found.forced:
            with np.errstate(all='ignore'):
                compare(sound, found)
                line_of_sight_table(
                    found.geometry.camera,
                    found.map_covariance,
                    pixel_grid(found.geometry.camera, 3, 3),
                )

    return _Kind(spoilt_text(path.read_text()), take)


def _state(calibration: Calibration, ensemble: Ensemble, folder: Path) -> _Kind:
    """Events and counts with new checksums, as anyone can compute them."""
    sound = folder.with_name('sound')
    archive = Archive(sound, 'camera')
    archive.keep(
        Ensemble(ensemble.images[:1], {'no_match': 3}),
        (Activation(1, 0, dataclasses.replace(calibration, number=1)),),
    )
    archive.close()
    files = sorted(sound.rglob('*.json'))

    def take(case: tuple[int, bytes]) -> None:
        which, content = case
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(sound, folder)
        (folder / files[which].relative_to(sound)).write_bytes(_sealed(content))
        found = Archive(folder, 'camera')
        try:
            images, history = found.read_ensemble(), found.read_history()
            if len(images.images) != 1 or len(history) > 1:
                raise AssertionError('other records were read')
            found.keep(images, history)
            if found.damage:
                raise StarcalError(found.damage[0])
        finally:
            found.close()

    cases = st.integers(0, len(files) - 1).flatmap(
        lambda k: st.tuples(st.just(k), spoilt_text(files[k].read_text()))
    )
    return _Kind(cases, take)


def _sealed(content: bytes) -> bytes:
    """The content with its checksum made right, where it is a JSON object."""
    try:
        found = json.loads(content)
        del found['sha256']
        text = json.dumps(found, sort_keys=True, separators=(',', ':'))
        digest = hashlib.sha256(text.encode()).hexdigest()
        return json.dumps({**found, 'sha256': digest}).encode()
    except (ValueError, KeyError, TypeError, RecursionError):
        return content


def _observations(sound: Ensemble, setup: Setup) -> _Kind:
    """Mutants of a message: refused, or saved and read again, and counted by an ensemble."""
    from bench.hostile import mutants
    from starcal_ros.messages.observations import checked_observations, observations_to_message
    from starcal_ros.nodes.lifecycle_node.message_factory import make_message

    brightest = sound.images[0].select(np.argsort(np.argsort(-sound.images[0].flux_dn)) < 20)
    template = observations_to_message(brightest, 'camera', make_message)

    def take(message: Any) -> None:
        record = checked_observations(message)
        BagWriter.one_observation('/observations', record, 'camera')
        ensemble = solve.add_to_ensemble(Ensemble(sound.images[1:4]), record, setup)
        status = solve.ensemble_status(ensemble, setup)
        if np.isnan(status.predicted_sigma).any():
            raise AssertionError('the predicted sigma is not a number')
        if record.refusal:
            raise StarcalError(record.detail)

    return _Kind(mutants(template), take)


def main() -> None:
    """Run one kind in this process."""
    name, count, *seconds = sys.argv[1:]
    limit_s = float(seconds[0]) if seconds else math.inf
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(dataclasses.asdict(fuzz(name, int(count), Path(folder), limit_s))))


if __name__ == '__main__':
    main()
