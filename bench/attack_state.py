# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attacks on the state folder of a calibrator: other setups, forged files, files that are none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import shutil
import tempfile
import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench import attack_sample as sample
from bench.attack_row import AttackRow
from starcal_ros.calibrator.archive import Activation, Archive
from starcal_ros.calibrator.seal import CHECKSUMS, Seal
from starcal_ros.calibrator.state import CalibratorState
from starcal_ros.errors import StarcalError
from starcal_ros.gate.judgement import judge, reasons_of
from starcal_ros.pipeline.node_options import CalibratorOptions
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Ensemble, refused_image

_KEY = b'a key of the attack bench, 32 B.'


def rows(quick: bool) -> list[AttackRow]:
    """Rows for restarts and for the state folder."""
    with tempfile.TemporaryDirectory() as folder:
        sound = Path(folder) / 'sound'
        write_state(sound)
        return [
            restarts(sound, 12 if quick else 300),
            forged(sound, 60 if quick else 10_000),
            forged_without_key(Path(folder), 20 if quick else 1000),
            no_files(sound),
            refusals(Path(folder) / 'refusals', 200 if quick else 5000),
        ]


def write_state(folder: Path, seal: Seal = CHECKSUMS) -> None:
    """A state folder with two images and two activations of one calibration."""
    first = dataclasses.replace(sample.calibration(), number=1, active_since_ns=10**9)
    second = dataclasses.replace(first, number=2)
    history = (Activation(1, 0, first), Activation(2, 1, second))
    with contextlib.closing(Archive(folder, 'camera', seal)) as archive:
        archive.keep(Ensemble(sample.observations()[:2], {'no_stars': 1}), history)


@contextlib.contextmanager
def _copied(sound: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=sound.parent) as folder:
        copy = Path(folder) / 'state'
        shutil.copytree(sound, copy)
        yield copy


def _opened(folder: Path, setup: Setup, key_file: str = '') -> CalibratorState:
    """A calibrator's state after a restart, closed again."""
    state = CalibratorState(time.time_ns)
    options = CalibratorOptions(state_dir=str(folder), state_key_file=key_file)
    with contextlib.suppress(StarcalError):  # in one line, and the node does not start
        state.open(setup, options)
    state.close()
    return state


def _is_wrong(state: CalibratorState, setup: Setup) -> bool:
    """Whether a calibration is active that the gate refuses, by a call of the gate itself."""
    active = state.active
    if active is None:
        return False
    return bool(reasons_of(judge(active, setup.prior, None, setup.gate, setup.calibration)))


def restarts(sound: Path, count: int) -> AttackRow:
    """Restarts with another prior, another mounting, tighter limits."""
    tally, lost, wrong, refused = sample.Tally('restarts'), 0, 0, 0
    draw = np.random.default_rng(14)
    for k in range(count):
        setup = _changed_setup(k, draw)
        with _copied(sound) as folder, tally.attempt(k):
            before = sample.digests(folder)
            state = _opened(folder, setup)
            wrong += _is_wrong(state, setup)
            refused += state.active is None
            assert (state.active is None) == bool(state.withheld), 'refused without reasons'
            lost += len(sample.changed(before, sample.digests(folder)))
    return AttackRow(
        'restart with another prior, mounting or limits', tally.tried, tally.survived, lost, wrong,
        f'{refused} refused with reasons, the others within the limits',
    )  # fmt: skip


def _changed_setup(k: int, draw: np.random.Generator) -> Setup:
    setup = sample.setup()
    prior, gate = setup.prior, setup.gate
    if k % 3 == 0:
        scale = 2400.0 / prior.camera.parameters[0] if k == 0 else draw.uniform(0.8, 1.25)
        fx, fy = scale * prior.camera.parameters[[0, 2]]
        camera = prior.camera.replace(fx=float(fx), fy=float(fy))
        prior = dataclasses.replace(prior, camera=camera)
    elif k % 3 == 1:
        turn = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
        if k != 1:
            turn = Rotation.from_rotvec(draw.normal(0.0, 0.03, 3))
        turned = Rotation.from_quat(prior.star_tracker_from_camera_xyzw) * turn
        prior = dataclasses.replace(prior, star_tracker_from_camera_xyzw=turned.as_quat())
    else:
        found = sample.calibration().gate
        limits = [c for c in found if c.option.startswith('max_') and hasattr(gate, c.option)]
        chosen = limits[draw.integers(len(limits))]
        limit: Any = draw.uniform(0, 2) * chosen.found
        gate = dataclasses.replace(gate, **{chosen.option: limit})
    return dataclasses.replace(setup, prior=prior, gate=gate)


def forged(sound: Path, count: int) -> AttackRow:
    """Files of calibrations with odd values and a right checksum."""
    tally, lost, wrong = sample.Tally('forged'), 0, 0
    setup = sample.setup()

    def attack(changes: list[tuple[int, object]]) -> None:
        nonlocal lost, wrong
        with _copied(sound) as folder, tally.attempt(changes):
            (path,) = folder.glob('calibrations/00000002_*')
            before = sample.digests(folder)
            del before[str(path.relative_to(folder))]
            _forge(path, changes, CHECKSUMS)
            state = _opened(folder, setup)
            wrong += _is_wrong(state, setup)
            lost += len(sample.changed(before, sample.digests(folder)))

    sample.odd_changes(count, 1, attack)
    return AttackRow(
        'forged state files with a right checksum', tally.tried, tally.survived, lost, wrong
    )


def _forge(path: Path, changes: list[tuple[int, object]], seal: Seal) -> None:
    content = json.loads(path.read_text())
    for key in ('sha256', 'hmac_sha256'):
        content.pop(key, None)
    changed = sample.with_changes(content, changes)
    assert isinstance(changed, dict)
    try:
        text = seal.sealed(changed)
    except ValueError:  # not finite, or too deep: as a forger would write it
        text = json.dumps(changed)
    path.write_text(text)


def forged_without_key(folder: Path, count: int) -> AttackRow:
    """Any change of a sealed file by someone without the key."""
    tally, lost, wrong = sample.Tally('without the key'), 0, 0
    sound, key_file, setup = folder / 'keyed', folder / 'key', sample.setup()
    key_file.write_bytes(_KEY)
    write_state(sound, Seal(_KEY))
    original = sample.calibration().geometry.camera.parameters[0]

    def attack(changes: list[tuple[int, object]]) -> None:
        nonlocal lost, wrong
        with _copied(sound) as copy, tally.attempt(changes):
            for path in copy.glob('calibrations/*.json'):
                _forge(path, changes, CHECKSUMS)
            (image, *_) = sorted(copy.glob('ensemble/*.mcap'))
            image.write_bytes(image.read_bytes()[:-1])
            state = _opened(copy, setup, str(key_file))
            wrong += state.active is not None
            wrong += len(state.ensemble.images) != 1

    sample.odd_changes(count, 2, attack)
    with _copied(sound) as copy, tally.attempt('unchanged'):
        state = _opened(copy, setup, str(key_file))
        assert state.active is not None
        assert state.active.geometry.camera.parameters[0] == original
        lost += len(state.ensemble.images) != 2
    return AttackRow(
        'state files changed without the key', tally.tried, tally.survived, lost, wrong
    )


def no_files(sound: Path) -> AttackRow:
    """Names and files that a calibrator never writes."""
    tally, lost, wrong = sample.Tally('no files'), 0, 0
    setup = sample.setup()
    for name, put in _STRANGE.items():
        with _copied(sound) as folder, tally.attempt(name):
            before = sample.digests(folder)
            put(folder)
            before = {name: old for name, old in before.items() if (folder / name).is_file()}
            state = _opened(folder, setup)
            wrong += _is_wrong(state, setup) or state.active is None
            assert state.solve().message, 'no answer'
            lost += len(sample.changed(before, sample.digests(folder)))
            lost += len(state.ensemble.images) != 2
    return AttackRow(
        'FIFOs, devices, links, stray names, huge files in the state folder',
        tally.tried, tally.survived, lost, wrong,
    )  # fmt: skip


def _sparse(path: Path) -> None:
    with path.open('wb') as file:
        file.truncate(1 << 40)


def fifo_in_place_of(path: Path) -> None:
    """Replace a file by a FIFO, which nobody writes to."""
    path.unlink()
    os.mkfifo(path)


_EVENT = 'calibrations/00000003_calibration_00000003.json'
_STRANGE: dict[str, Callable[[Path], object]] = {
    'FIFO as image': lambda f: os.mkfifo(f / 'ensemble/00000003.mcap'),
    'FIFO as calibration': lambda f: os.mkfifo(f / _EVENT),
    'FIFO as refused': lambda f: fifo_in_place_of(f / 'ensemble/refused.json'),
    '/dev/zero as image': lambda f: (f / 'ensemble/00000003.mcap').symlink_to('/dev/zero'),
    '/dev/zero as calibration': lambda f: (f / _EVENT).symlink_to('/dev/zero'),
    'link to itself': lambda f: (f / _EVENT).symlink_to(f / _EVENT),
    'folder as calibration': lambda f: (f / _EVENT).mkdir(),
    'folder as image': lambda f: (f / 'ensemble/00000003.mcap').mkdir(),
    '10^20_x': lambda f: (f / f'calibrations/{10**20}_x').write_text(''),
    '10^20 as event': lambda f: (
        f / f'calibrations/{10**20}_calibration_{10**20}.json'
    ).write_text('{}'),
    '10^20 as image': lambda f: (f / f'ensemble/{10**20}.mcap').write_text(''),
    '999999999 as event': lambda f: (
        f / 'calibrations/999999999_calibration_00000001.json'
    ).write_text('{}'),
    'Arabic digits': lambda f: (f / 'ensemble/٠٠٠٠٠٠٠٣.mcap').write_text(''),
    'no UTF-8': lambda f: Path(os.fsdecode(bytes(f) + b'/ensemble/\xff\xfe.mcap')).write_text(''),
    'new line in a name': lambda f: (f / 'ensemble/00000003\n.mcap').write_text(''),
    'a TB as image': lambda f: _sparse(f / 'ensemble/00000003.mcap'),
    'a TB as calibration': lambda f: _sparse(f / _EVENT),
    'deep JSON': lambda f: (f / _EVENT).write_text('[' * 100_000),
    'digits': lambda f: (f / _EVENT).write_text('9' * 100_000),
    'nothing': lambda f: (f / _EVENT).write_text(''),
}


def refusals(folder: Path, count: int) -> AttackRow:
    """Refused images, each for a reason of its own: file and time stay small."""
    tally = sample.Tally('refusals')
    state = CalibratorState(time.time_ns)
    state.open(sample.setup(), CalibratorOptions(state_dir=str(folder)))
    took_s: list[float] = []
    for k in range(count):
        with tally.attempt(k):
            start_s = time.monotonic()
            state.add(refused_image(k, 640, 512, f'reason {k} ' + 'x' * 100, ''))
            took_s.append(time.monotonic() - start_s)
    size = (folder / 'ensemble/refused.json').stat().st_size
    lost = count - sum(state.ensemble.refused.values())
    state.close()
    assert size < 1000, f'refused.json has {size} bytes'
    return AttackRow(
        'refused images, each with a reason of its own', tally.tried, tally.survived, lost, 0,
        f'refused.json has {size} bytes, {1000 * float(np.median(took_s)):.0f} ms each',
    )  # fmt: skip
