# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The state folder: what was kept comes back, through kills, damage and files without access."""

import contextlib
import dataclasses
import json
import multiprocessing
import os
from pathlib import Path
import shutil
import tempfile
import time

from attacks import NO_FILES  # type: ignore[import-not-found]
from kept_state import activation, collect, images, opened  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_records import assert_same  # type: ignore[import-not-found]

from starcal_ground.bags import reader as bag_reader
from starcal_ros.errors import ArchiveError, OptionError
from starcal_ros.records import Activation, Ensemble
from starcal_ros.ros.archive import Archive, CHECKSUMS, read_seal, Seal, TOPIC

KEYED = Seal(b'sixteen bytes...')
CONTENT = {'number': 3, 'list': [0.1, None, 'µ'], 'schema': 1}


def numbers(history: tuple[Activation, ...]) -> list[tuple[int, int]]:
    return [(record.event, record.calibration.number) for record in history]


def test_what_is_kept_comes_back_to_the_last_bit(tmp_path) -> None:
    """In order of arrival, which is not that of the stamps."""
    kept = Ensemble((images()[2], images()[0], images()[1]), {'no_stars': 3})
    history = (activation(1), activation(2, before=1))
    with opened(tmp_path / 'new' / 'state') as archive:
        assert archive.read_ensemble() == Ensemble() and archive.read_history() == ()
        archive.keep(Ensemble(kept.images[:2]), history[:1])
        archive.keep(kept, history)
        assert archive.saved(kept) == 3
    with opened(tmp_path / 'new' / 'state') as archive:
        ensemble, again = archive.read_ensemble(), archive.read_history()
        assert archive.damage == [] and archive.last_event == 2
    assert dict(ensemble.refused) == {'no_stars': 3}
    for a, b in zip(kept.images, ensemble.images, strict=True):
        assert_same(a, b)
    for one, other in zip(history, again, strict=True):
        assert (one.event, one.before) == (other.event, other.before)
        assert_same(one.calibration, other.calibration)


def test_another_image_of_a_stamp_on_disk_takes_its_place(tmp_path) -> None:
    """A reset that the disk did not take must not bring the first one back."""
    first, second = images()[0], dataclasses.replace(images()[1], time_ns=images()[0].time_ns)
    with opened(tmp_path) as archive:
        archive.keep(Ensemble((first, images()[2])), ())
        grown = Ensemble((images()[2], second))
        assert archive.saved(grown) == 1
        archive.keep(grown, ())
        assert archive.saved(grown) == 2
    with opened(tmp_path) as archive:
        for a, b in zip(grown.images, archive.read_ensemble().images, strict=True):
            assert_same(a, b)


def test_what_is_saved_is_in_the_folder_that_is_locked(tmp_path) -> None:
    """A removed or replaced one has no image; put back, it has the images and takes others."""
    folder, moved, grown = tmp_path / 'state', tmp_path / 'moved', Ensemble(images()[:2])
    with opened(folder) as archive:
        archive.keep(Ensemble(images()[:1]), ())
        folder.rename(moved)
        for change in (lambda: None, folder.mkdir):
            change()
            assert archive.saved(grown) == 0
            with pytest.raises(ArchiveError, match='was removed or replaced; put it back'):
                archive.keep(grown, ())
        folder.rmdir()
        moved.rename(folder)
        archive.keep(grown, ())
        assert archive.saved(grown) == 2


def test_the_ensemble_is_a_bag_and_no_metadata_lacks_an_image(tmp_path) -> None:
    """A description that another program left is removed: all images are read."""
    with opened(tmp_path) as archive:
        archive.keep(Ensemble(images()[:2]), ())
    (tmp_path / 'ensemble/metadata.yaml').write_text('of ros2 bag reindex')
    with opened(tmp_path) as archive:
        archive.keep(Ensemble((*archive.read_ensemble().images, images()[2])), ())
    assert not (tmp_path / 'ensemble/metadata.yaml').exists()
    found = list(bag_reader.read_observations([tmp_path / 'ensemble'], TOPIC))
    assert [one.time_ns for one in found] == [one.time_ns for one in images()[:3]]
    # A file of a longer number would not be read again.
    path = max((tmp_path / 'ensemble').glob('*.mcap'))
    path.rename(path.with_name('999999999.mcap'))
    with opened(tmp_path) as archive:
        kept = archive.read_ensemble().images
        with pytest.raises(ArchiveError, match='move the files with the highest numbers'):
            archive.keep(Ensemble((*kept, images()[3])), ())


def test_what_goes_from_the_ensemble_goes_from_the_disk(tmp_path) -> None:
    with opened(tmp_path) as archive:
        archive.keep(Ensemble(images()[:4], {'no_stars': 1}), ())
        archive.keep(Ensemble((*images()[:2], *images()[3:5])), ())
    with opened(tmp_path) as archive:
        stamps = [image.time_ns for image in archive.read_ensemble().images]
        assert stamps == [images()[k].time_ns for k in (0, 1, 3, 4)]
        archive.keep(Ensemble(), ())
    with opened(tmp_path) as archive:
        assert archive.read_ensemble() == Ensemble()
        archive.keep(Ensemble(images()[:1]), ())
        assert archive.saved(Ensemble(images()[:2])) == 1
    with opened(tmp_path) as archive:  # it has come again after a reset
        assert len(archive.read_ensemble().images) == 1


@pytest.mark.slow
def test_killed_at_any_instant(tmp_path) -> None:
    """What was told of as kept is there after each of ten kills, and nothing is damaged."""
    processes = multiprocessing.get_context('forkserver')
    processes.set_forkserver_preload(
        ['starcal_ros.ros.archive', 'starcal_ground.simulation.scenario']
    )
    random = np.random.default_rng(5)
    for _ in range(10):
        reader, writer = processes.Pipe(duplex=False)
        child = processes.Process(target=collect, args=(tmp_path, images()[:3], writer))
        child.start()
        writer.close()
        said = [reader.recv()]
        time.sleep(random.uniform(0.0, 0.04))  # the instant is what is drawn at random
        child.kill()
        child.join()
        with contextlib.suppress(EOFError):
            while True:
                said.append(reader.recv())
        reader.close()
        last_image, last_event = said[-1]
        with opened(tmp_path) as archive:
            ensemble, history = archive.read_ensemble(), archive.read_history()
            assert archive.damage == []
        stamps = [image.time_ns for image in ensemble.images]
        assert stamps == list(range(len(stamps))) and len(stamps) in (
            last_image + 1,
            last_image + 2,  # kept, but killed before it was told
        )
        assert history[-1].event in (last_event, last_event + 1)
        assert not list(tmp_path.glob('*/.*'))


@pytest.mark.parametrize('kind', ['flip', 'cut'])
@pytest.mark.parametrize('pattern', ['ensemble/*.mcap', 'calibrations/*2.json'])
def test_a_damaged_file_is_never_believed(tmp_path, pattern, kind) -> None:
    """It is read as it was written (a flip where nothing is said), or set aside and named."""
    sound = tmp_path / 'sound'
    with opened(sound) as archive:
        archive.keep(Ensemble(images()[:1]), (activation(1), activation(2, before=1)))
    random = np.random.default_rng(3)
    set_aside = 0
    for k in range(24):
        folder = tmp_path / f'{k}'
        shutil.copytree(sound, folder)
        (victim,) = folder.glob(pattern)
        data = bytearray(victim.read_bytes())
        place = int(random.integers(len(data)))
        if kind == 'flip':
            data[place] ^= 1 << int(random.integers(8))
        else:
            del data[place:]
        victim.write_bytes(data)
        with opened(folder) as archive:
            ensemble, history = archive.read_ensemble(), archive.read_history()
            damage = archive.damage
        aside = list(folder.glob('*/*.damaged'))
        assert len(damage) == len(aside) <= 1
        set_aside += len(aside)
        if aside:
            assert aside[0].name == f'{victim.name}.damaged' and str(aside[0]) in damage[0]
        if aside and pattern.startswith('ensemble'):
            assert ensemble.images == ()
        else:
            assert_same(ensemble.images[0], images()[0])
        expected = [(1, 1)] if aside and pattern.startswith('calib') else [(1, 1), (2, 2)]
        assert numbers(history) == expected
        assert history[-1].calibration.residual_rms_px == expected[-1][1] / 7
    # Flips in the white space of JSON, or in the index of a bag, change nothing that is read.
    assert set_aside >= (12 if kind == 'flip' else 22)


def test_a_damaged_rollback_still_goes_back(tmp_path) -> None:
    """Its name says to which calibration, and that one has a file of its own."""
    with opened(tmp_path) as archive:
        back = activation(3, number=1)
        archive.keep(Ensemble(), (activation(1), activation(2, before=1), back))
    next(tmp_path.glob('calibrations/00000003_*')).write_bytes(b'{"half')
    with opened(tmp_path) as archive:
        history = archive.read_history()
        assert numbers(history) == [(1, 1), (2, 2), (3, 1)]
        archive.keep(Ensemble(), history)
    with opened(tmp_path) as archive:
        assert numbers(archive.read_history()) == [(1, 1), (2, 2), (3, 1)]
        assert archive.damage == []


@pytest.mark.parametrize('key', ['schema', 'archive'])
def test_another_version_is_left_where_it_is_and_no_event_is_given_twice(tmp_path, key) -> None:
    with opened(tmp_path) as archive:
        archive.keep(Ensemble(), (activation(1), activation(2, before=1)))
    path = next(tmp_path.glob('calibrations/00000002_*'))
    content = json.loads(path.read_text())
    del content['sha256']
    content[key] = 99 if key == 'schema' else {'schema': 99}
    path.write_text(Seal().sealed(content))
    with opened(tmp_path) as archive:
        assert numbers(archive.read_history()) == [(1, 1)]
        assert archive.damage == [f'{path}: of another version, skipped']
    assert path.exists()
    path.write_bytes(b'')
    with opened(tmp_path) as archive:
        assert numbers(archive.read_history()) == [(1, 1)]
        assert archive.last_event == 2


def test_what_is_no_folder_is_refused(tmp_path) -> None:
    (tmp_path / 'file').write_text('')
    for path in (tmp_path / 'file', tmp_path / 'file' / 'below'):
        with pytest.raises(ArchiveError, match=f'state_dir: {path}'):
            Archive(path, 'camera')


def test_a_checksum_can_be_made_again_and_an_hmac_only_with_the_key() -> None:
    forged = {**CONTENT, 'number': 4}
    text = CHECKSUMS.sealed(forged).encode()
    assert CHECKSUMS.opened(text) == forged
    with pytest.raises(ValueError, match='the HMAC is missing'):
        KEYED.opened(text)
    other = Seal(b'another sixteen.').sealed(forged).encode()
    with pytest.raises(ValueError, match='the HMAC is wrong'):
        KEYED.opened(other)
    sealed = KEYED.sealed(CONTENT).encode()
    assert KEYED.opened(sealed) == CONTENT
    assert CHECKSUMS.opened(sealed) == CONTENT  # the key was taken away
    why = "checksum|not JSON|not a JSON object|codec can't decode"
    for data in (b'', b'[]', b'{}', b'3', b'\xff', b'[' * 10**5, b'{"a": 1}'):
        with pytest.raises(ValueError, match=why):
            CHECKSUMS.opened(data)


def test_the_mark_of_a_file_is_of_its_number_and_bytes() -> None:
    mark = KEYED.mark(7, b'bytes')
    assert len(mark) == 64
    KEYED.check_mark(mark, 7, b'bytes')
    for found, number, data in ((mark, 8, b'bytes'), (mark, 7, b'byte'), ('', 7, b'bytes')):
        with pytest.raises(ValueError, match='HMAC'):
            KEYED.check_mark(found, number, data)
    assert CHECKSUMS.mark(7, b'bytes') == ''
    CHECKSUMS.check_mark('anything', 7, b'bytes')


def test_the_key_file(tmp_path) -> None:
    path = tmp_path / 'key'
    path.write_bytes(KEYED.key + b'\n')
    assert read_seal(str(path)) == KEYED
    assert read_seal('') == CHECKSUMS
    path.write_bytes(b'short')
    with pytest.raises(OptionError, match='holds 5 bytes, at least 16'):
        read_seal(str(path))
    os.mkfifo(tmp_path / 'fifo')
    for name in ('fifo', 'none', '.'):
        with pytest.raises(OptionError, match='state_key_file'):
            read_seal(str(tmp_path / name))


NOBODY = 65534  # a user who owns none of the files
IMAGE, REFUSED = 'ensemble/00000001.mcap', 'ensemble/refused.json'
EVENT = 'calibrations/00000002_calibration_00000002.json'
STOPS, SKIPPED, SET_ASIDE = 'cannot be read', 'not a regular file, skipped', 'set aside'
# What is at a name of the folder in place of a sound file, and what a start makes of it.
CASES = [
    *(('no access', name, STOPS) for name in (IMAGE, REFUSED, EVENT, 'ensemble', 'calibrations')),
    *(('folder', name, SKIPPED) for name in (IMAGE, REFUSED, EVENT)),
    *((kind, name, SKIPPED) for kind in ('dangling link', 'pipe') for name in (IMAGE, EVENT)),
    *(('cut', name, SET_ASIDE) for name in (IMAGE, REFUSED, EVENT)),
]


def spoil(path: Path, kind: str) -> None:
    if kind == 'no access':
        path.chmod(0)
    elif kind == 'cut':
        os.truncate(path, path.stat().st_size // 2)
    else:
        path.unlink()
        NO_FILES[kind](path)


def start(folder: Path) -> tuple[str, list[str]]:
    try:
        with contextlib.closing(Archive(folder, 'camera')) as archive:
            archive.read_ensemble(), archive.read_history()
            return '', archive.damage
    except ArchiveError as error:
        return str(error), []


@pytest.mark.slow
@pytest.mark.parametrize(('kind', 'name', 'outcome'), CASES)
def test_only_what_was_read_and_is_wrong_is_set_aside(kind, name, outcome) -> None:
    """The start ends where a file may be sound; nothing is renamed then."""
    with tempfile.TemporaryDirectory() as place:  # others have no access to that of pytest
        folder = Path(place) / 'state'
        with opened(folder) as archive:
            history = (activation(1), activation(2, before=1))
            archive.keep(Ensemble(images()[:2], {'no_stars': 1}), history)
        start(folder)  # loads all that a start needs while this user may
        spoil(folder / name, kind)
        for path in (Path(place), folder, *folder.iterdir()):
            if path.stat().st_mode & 0o777:
                path.chmod(0o777)  # anybody may rename the files
        with contextlib.ExitStack() as stack:
            if os.geteuid() == 0:  # modes stop any other user already
                os.seteuid(NOBODY)
                stack.callback(os.seteuid, 0)
            error, damage = start(folder)
        for path in folder.iterdir():
            path.chmod(0o700)
        damaged = sorted(folder.glob('*/*.damaged'))
        aside = [path.relative_to(folder).as_posix() for path in damaged]
    if outcome == STOPS:
        assert f'{folder / name} cannot be read: Permission denied; start the' in error
        assert aside == [] and error.count('\n') == 0
    else:
        assert error == '' and len(damage) == 1 and outcome in damage[0]
        assert aside == ([f'{name}.damaged'] if outcome == SET_ASIDE else [])
