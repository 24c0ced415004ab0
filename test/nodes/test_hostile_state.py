# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Hostile state folders of a calibrator: forged files, and names that are no files of its own."""

from collections.abc import Callable
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import shutil
import tempfile
import time

from attacks import (  # type: ignore[import-not-found]
    bag_setup,
    calibration,
    CHANGES,
    digests,
    drawn,
    NO_FILES,
    observations,
    with_changes,
)
from hypothesis import given
import pytest
from sample_records import without_field  # type: ignore[import-not-found]

from starcal_ros.assessment.gate import judge, reasons_of
from starcal_ros.errors import StarcalError
from starcal_ros.pipeline.setup import CalibratorOptions
from starcal_ros.records import Activation, Ensemble
from starcal_ros.ros.archive import Archive, CHECKSUMS, Seal
from starcal_ros.ros.joining import Collections
from starcal_ros.ros.state import CalibratorState

pytestmark = pytest.mark.slow

KEY = b'the key of these tests, 32 bytes'
Change = list[tuple[int, object]]


def write_state(folder: Path, seal: Seal) -> Path:
    """A state folder with two images and two activations of one calibration."""
    first, second = (
        dataclasses.replace(one, number=number, active_since_ns=10**9)
        for number, one in ((1, without_field(calibration())), (2, calibration()))
    )
    history = (Activation(1, 0, first), Activation(2, 1, second))
    with contextlib.closing(Archive(folder, 'camera', seal, 'star_tracker')) as archive:
        ensemble = Ensemble(observations()[:2], {'no_stars': 1})
        archive.keep(ensemble, history, Collections().begun())
    return folder


@pytest.fixture(scope='module')
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_state(tmp_path_factory.mktemp('sound') / 'state', CHECKSUMS)


@pytest.fixture(scope='module')
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('keyed')
    (folder / 'key').write_bytes(KEY)
    return write_state(folder / 'state', Seal(KEY))


@contextlib.contextmanager
def copied(folder: Path):
    with tempfile.TemporaryDirectory(dir=folder.parent) as parent:
        copy = Path(parent) / 'state'
        shutil.copytree(folder, copy)
        yield copy


def restarted(folder: Path, key_file: object = '') -> CalibratorState:
    """A calibrator's state after a restart, closed again."""
    state = CalibratorState(time.time_ns)
    options = CalibratorOptions(state_dir=str(folder), state_key_file=str(key_file))
    with contextlib.suppress(StarcalError):  # then the node does not start
        state.open(bag_setup(), options)
    state.close()
    return state


def passes_the_gate(state: CalibratorState) -> bool:
    """No calibration is active that the gate refuses, by a call of the gate itself."""
    if state.active is None:
        return True
    checks = judge(
        state.active, bag_setup().prior, None, bag_setup().gate, bag_setup().calibration
    )
    return not reasons_of(checks)


def forge(path: Path, changes: Change) -> None:
    """Change a state file and compute its checksum again, as anyone can."""
    content = json.loads(path.read_text())
    for key in ('sha256', 'hmac_sha256'):
        content.pop(key, None)
    changed = with_changes(content, changes)
    try:
        text = CHECKSUMS.sealed(changed)
    except ValueError:  # not finite, or too deep: as a forger would write it
        text = json.dumps(changed)
    path.write_text(text)


@pytest.mark.parametrize('file', ['calibrations/00000002_*', 'ensemble/refused.json'])
@drawn(40)
@given(changes=CHANGES)
def test_a_forged_file_makes_nothing_active_past_the_gate(sound, file, changes) -> None:
    """All other files are read, and stay as they are."""
    with copied(sound) as folder:
        (path,) = folder.glob(file)
        before = digests(folder)
        del before[str(path.relative_to(folder))]
        forge(path, changes)
        state = restarted(folder)
        assert passes_the_gate(state) and state.trouble == ''
        assert len(state.ensemble.images) == 2
        assert all('\n' not in text for text in state.damage)
        assert before.items() <= digests(folder).items()


@drawn(20)
@given(CHANGES)
def test_nothing_changed_without_the_key_is_used(keyed, changes) -> None:
    with copied(keyed) as folder:
        for path in folder.glob('calibrations/*.json'):
            forge(path, changes)
        first = min(folder.glob('ensemble/*.mcap'))
        # As a calibrator without the key writes it.
        shutil.copy(first, first.with_name('00000001.mcap'))
        first.write_bytes(first.read_bytes()[:-1])
        state = restarted(folder, keyed.with_name('key'))
        assert state.active is None and len(state.ensemble.images) == 1
        assert any('00000001.mcap' in t and 'HMAC is missing' in t for t in state.damage)


def test_what_is_sealed_with_the_key_is_used(keyed) -> None:
    with copied(keyed) as folder:
        state = restarted(folder, keyed.with_name('key'))
        assert state.active is not None and len(state.ensemble.images) == 2


_IMAGE = 'ensemble/00000003.mcap'
_EVENT = 'calibrations/00000003_calibration_00000003.json'
STRANGE: dict[str, tuple[str, Callable[[Path], object]]] = {
    **{f'a {kind} as image': (_IMAGE, NO_FILES[kind]) for kind in ('device', 'sparse')},
    **{f'a {kind} as calibration': (_EVENT, NO_FILES[kind]) for kind in ('device', 'sparse')},
    '10^20_x': (f'calibrations/{10**20}_x', Path.touch),
    '10^20 as event': (f'calibrations/{10**20}_calibration_{10**20}.json', Path.touch),
    '10^20 as image': (f'ensemble/{10**20}.mcap', Path.touch),
    '999999999 as event': ('calibrations/999999999_calibration_00000001.json', Path.touch),
    'Arabic digits': ('ensemble/٠٠٠٠٠٠٠٣.mcap', Path.touch),
    'no UTF-8': (os.fsdecode(b'ensemble/\xff\xfe.mcap'), Path.touch),
    'new line in a name': ('ensemble/00000003\n.mcap', Path.touch),
}


@pytest.mark.parametrize('name', ['ensemble', 'calibrations', 'ensemble.emptied', 'other'])
def test_nothing_behind_a_link_is_removed(name, sound, tmp_path) -> None:
    """It names the folder of another calibrator, whose files have the same names."""
    with copied(sound) as others:
        (others / 'ensemble/.00000003.mcap.0.part').touch()
        (others / 'ensemble/metadata.yaml').touch()
        before = digests(others)
        for part in others.iterdir():
            state = tmp_path / part.name
            state.mkdir()
            (state / name).symlink_to(part)
            restarted(state)
            assert digests(others) == before
            (state / name).unlink()
            assert restarted(state).trouble == ''  # the folder was let go of


@pytest.mark.parametrize('name', STRANGE)
def test_names_and_files_that_a_calibrator_never_writes(name, sound) -> None:
    with copied(sound) as folder:
        before = digests(folder)
        place, make = STRANGE[name]
        make(folder / place)
        before = {name: old for name, old in before.items() if (folder / name).is_file()}
        state = restarted(folder)
        assert state.active is not None and passes_the_gate(state)
        assert len(state.ensemble.images) == 2
        assert state.solve().message
        assert before.items() <= digests(folder).items()
