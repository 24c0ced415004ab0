# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
State on disk: the ensemble, and the activated calibrations, safe from a crash.

``ensemble/00000012.mcap`` is one image, numbered in order of arrival: a whole bag that any reader
of MCAP opens.  ``ensemble/refused.json`` counts the refused images.
``calibrations/00000007_calibration_00000003.json`` records that event 7 activated calibration 3
(here by a roll-back): a ``calibration.json`` with two more keys.

A file is written beside its place, synced, renamed, and the folder synced; it is never changed
afterwards.  So at any instant each file is complete or absent.  A checksum detects damage by the
disk: such a file is renamed to ``….damaged`` and skipped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
from dataclasses import dataclass, field
import fcntl
import hashlib
import json
import os
from pathlib import Path
import re
import shutil
from typing import Any

from starcal_ros.arrays import Count
from starcal_ros.bag.reader import read_observations
from starcal_ros.bag.writer import BagWriter
from starcal_ros.errors import ArchiveError, BagError, ProductError
from starcal_ros.products.calibration_json import (
    calibration_content,
    calibration_from_content,
    SCHEMA,
)
from starcal_ros.products.files import PART, sync_folder, write_atomically
from starcal_ros.products.json_codec import from_json, to_json
from starcal_ros.records import Calibration, Ensemble, StarObservations

ARCHIVE_SCHEMA = 1
TOPIC = '/observations'

_ENSEMBLE, _CALIBRATIONS, _EMPTIED = 'ensemble', 'calibrations', 'ensemble.emptied'
_REFUSED = 'refused.json'
_EVENT_NAME = re.compile(r'(\d{8,})_calibration_(\d{8,})\.json')
_NUMBERED = re.compile(r'\.?(\d{8,})[._]')


@dataclass(frozen=True)
class Activation:
    """
    A calibration was activated, for the first time or by a roll-back.

    ``event`` counts activations; ``before`` is the event that a roll-back of this one returns to,
    0 for none.  The calibration is active until the next event.
    """

    event: int
    before: int
    calibration: Calibration


@dataclass(frozen=True)
class _ActivationKeys:
    """The key ``archive`` of the file of an activation."""

    schema: int
    event: Count
    before: Count


@dataclass(frozen=True)
class _RefusedFile:
    """The file of the counts of refused images, by reason."""

    schema: int
    refused: Mapping[str, Count] = field(default_factory=dict)


@dataclass(frozen=True)
class _Kept:
    """An image on disk, and its file."""

    image: StarObservations
    path: Path


class Archive:
    """
    A state folder, locked by this process until `close`.

    The records in memory are authoritative; `keep` writes them.  Not safe for several threads.

    Attributes
    ----------
    damage : list of str
        A sentence for each file that was set aside or skipped.
    last_event : int
        The highest number given to any file.

    Raises
    ------
    ArchiveError
        When the folder cannot be made or read, or another process has locked it.
    """

    def __init__(self, folder: Path, frame_id: str) -> None:
        self.folder = folder
        self.damage: list[str] = []
        self.last_event = 0
        self._frame_id = frame_id
        self._images: dict[int, _Kept] = {}  # by stamp: those on disk
        self._next_image = 1
        self._refused: dict[str, int] = {}
        self._events: dict[int, Path] = {}  # those on disk
        self._lock = _locked(folder)
        shutil.rmtree(folder / _EMPTIED, ignore_errors=True)
        for part in folder.glob(f'*/.*{PART}'):
            with contextlib.suppress(OSError):
                part.unlink()

    def close(self) -> None:
        """Unlock the folder; safe to call twice."""
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def saved(self, ensemble: Ensemble) -> int:
        """Number of images of an ensemble on disk."""
        return sum(map(self._holds, ensemble.images))

    def _holds(self, image: StarObservations) -> bool:
        # Not by its stamp: after a reset that failed on disk, another image may have it.
        kept = self._images.get(image.time_ns)
        return kept is not None and kept.image is image

    def free_bytes(self) -> int:
        """Free space on the disk; 0 where it cannot be read."""
        try:
            return shutil.disk_usage(self.folder).free
        except OSError:
            return 0

    def read_ensemble(self) -> Ensemble:
        """The ensemble on disk, in order of arrival; damaged images are set aside."""
        images = []
        for path in self._files(_ENSEMBLE, '*.mcap'):
            image = self._read_image(path)
            if image is not None and image.time_ns not in self._images:
                images.append(image)
                self._images[image.time_ns] = _Kept(image, path)
        for path in self._files(_ENSEMBLE, _REFUSED):
            self._refused = self._read_refused(path)
        return Ensemble(tuple(images), dict(self._refused))

    def read_history(self) -> tuple[Activation, ...]:
        """
        The activations on disk, in order; the calibration of the last is active.

        Where the last is damaged, another file of the same calibration replaces it, else the event
        before.
        """
        history: list[Activation] = []
        last_number = 0
        for path in self._files(_CALIBRATIONS, '*.json'):
            name = _EVENT_NAME.fullmatch(path.name)
            if name is None:
                continue
            event, last_number = int(name[1]), int(name[2])
            record = self._read_event(path, event)
            if record is not None:
                history.append(record)
                self._events[event] = path
        same = [record for record in history if record.calibration.number == last_number]
        if same and history[-1].calibration.number != last_number:
            history.append(Activation(self.last_event, same[-1].before, same[-1].calibration))
        return tuple(history)

    def keep(self, ensemble: Ensemble, history: tuple[Activation, ...]) -> None:
        """
        Make the folder hold these; returns at once where it holds them already.

        A new image costs one file.  Where the ensemble has no image in common with the one on
        disk, that one is removed first, in one step.

        Raises
        ------
        ArchiveError
            When writing fails; the files on disk stay intact, and the next call continues.
        """
        current = {image.time_ns for image in ensemble.images}
        try:
            for record in history:
                self._keep_event(record)
            if self._images and not current & self._images.keys():
                self._empty()
            for image in ensemble.images:
                if not self._holds(image):
                    self._keep_image(image)
            if dict(ensemble.refused) != self._refused:
                content = _RefusedFile(ARCHIVE_SCHEMA, dict(ensemble.refused))
                self._write(_ENSEMBLE, _REFUSED, _sealed(to_json(content)))
                self._refused = dict(ensemble.refused)
        except ProductError as error:
            raise ArchiveError(f'state_dir: {error}') from error
        except OSError as error:
            raise ArchiveError(
                f'state_dir: {error.filename or self.folder}: {error.strerror}'
            ) from error
        finally:  # on a full disk, removed files make room for the next call
            self._drop(current, {record.event for record in history})

    def _keep_event(self, record: Activation) -> None:
        if record.event in self._events:
            return
        content = {
            **calibration_content(record.calibration),
            'archive': to_json(_ActivationKeys(ARCHIVE_SCHEMA, record.event, record.before)),
        }
        name = f'{record.event:08d}_calibration_{record.calibration.number:08d}.json'
        self._events[record.event] = self._write(_CALIBRATIONS, name, _sealed(content))
        self.last_event = max(self.last_event, record.event)

    def _keep_image(self, image: StarObservations) -> None:
        stale = self._images.get(image.time_ns)
        if stale is not None:
            stale.path.unlink(missing_ok=True)
            del self._images[image.time_ns]
        data = BagWriter.one_observation(TOPIC, image, self._frame_id)
        path = self._write(_ENSEMBLE, f'{self._next_image:08d}.mcap', data)
        self._images[image.time_ns] = _Kept(image, path)
        self._next_image += 1

    def _write(self, folder: str, name: str, content: str | bytes) -> Path:
        path = self.folder / folder / name
        if not path.parent.is_dir():
            path.parent.mkdir()
            sync_folder(self.folder)
        write_atomically(path, content)
        return path

    def _drop(self, images: set[int], events: set[int]) -> None:
        for stamp in self._images.keys() - images:
            with contextlib.suppress(OSError):
                self._images[stamp].path.unlink(missing_ok=True)
                del self._images[stamp]
        for event in self._events.keys() - events:
            with contextlib.suppress(OSError):
                self._events[event].unlink(missing_ok=True)
                del self._events[event]

    def _empty(self) -> None:
        shutil.rmtree(self.folder / _EMPTIED, ignore_errors=True)
        (self.folder / _ENSEMBLE).rename(self.folder / _EMPTIED)
        self._images.clear()
        self._refused = {}
        sync_folder(self.folder)
        shutil.rmtree(self.folder / _EMPTIED, ignore_errors=True)

    def _files(self, folder: str, pattern: str) -> Iterator[Path]:
        """Files in order of their numbers; the highest number of any file is remembered."""
        try:
            names = [path.name for path in (self.folder / folder).iterdir()]
        except FileNotFoundError:
            return
        except OSError as error:
            raise ArchiveError(f'state_dir: {error.filename}: {error.strerror}') from error
        highest = max((int(n[1]) for n in map(_NUMBERED.match, names) if n), default=0)
        if folder == _ENSEMBLE:
            self._next_image = max(self._next_image, highest + 1)
        else:
            self.last_event = max(self.last_event, highest)
        for name in sorted(names):
            path = self.folder / folder / name
            if path.match(pattern) and not name.startswith('.'):
                yield path

    def _read_image(self, path: Path) -> StarObservations | None:
        damage: list[str] = []
        try:
            found = list(read_observations([path], TOPIC, damage.append))
        except BagError as error:
            found, damage = [], [str(error)]
        if damage or len(found) != 1:
            self._set_aside(path, damage[0] if damage else f'{len(found)} images, not one')
            return None
        return found[0]

    def _read_event(self, path: Path, event: int) -> Activation | None:
        content = self._unsealed(path, 'schema', SCHEMA)
        if content is None:
            return None
        archive = content.get('archive')
        if not isinstance(archive, dict) or archive.get('schema') != ARCHIVE_SCHEMA:
            self.damage.append(f'{path}: of another version, skipped')
            return None
        try:
            keys = from_json(_ActivationKeys, archive, 'archive')
            return Activation(event, keys.before, calibration_from_content(path, content))
        except (ProductError, ValueError) as error:
            self._set_aside(path, str(error))
            return None

    def _read_refused(self, path: Path) -> dict[str, int]:
        content = self._unsealed(path, 'schema', ARCHIVE_SCHEMA)
        if content is None:
            return {}
        try:
            return dict(from_json(_RefusedFile, content).refused)
        except ValueError as error:
            self._set_aside(path, str(error))
            return {}

    def _unsealed(self, path: Path, key: str, schema: int) -> Mapping[str, Any] | None:
        """The JSON object of a file with the right checksum and this schema; else None."""
        try:
            content = json.loads(path.read_bytes())
            digest = content.pop('sha256')
            if digest != _digest(content):
                raise ValueError('the checksum is wrong')
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            self._set_aside(path, f'{type(error).__name__}: {error}')
            return None
        if content.get(key) != schema:
            self.damage.append(f'{path}: of another version, skipped')
            return None
        return dict(content)

    def _set_aside(self, path: Path, why: str) -> None:
        aside = path.with_name(f'{path.name}.damaged')
        with contextlib.suppress(OSError):  # on a read-only disk it is skipped where it is
            path.rename(aside)
        self.damage.append(f'{aside}: damaged, set aside: {" ".join(why.split())}')


def _locked(folder: Path) -> int:
    """Descriptor with a lock on the folder, which the system releases when the process ends."""
    number = -1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if number >= 0:
            os.close(number)
        if isinstance(error, BlockingIOError):
            raise ArchiveError(f'state_dir: {folder} is in use by another calibrator') from error
        raise ArchiveError(f'state_dir: {folder}: {error.strerror}') from error
    return number


def _sealed(content: dict[str, object]) -> str:
    """JSON text of an object with its checksum as the last key."""
    sealed = {**content, 'sha256': _digest(content)}
    return json.dumps(sealed, indent=1, allow_nan=False) + '\n'


def _digest(content: Mapping[str, object]) -> str:
    # Numbers are written with the digits that read back to the same double, so the text is unique.
    text = json.dumps(content, sort_keys=True, separators=(',', ':'))
    return hashlib.sha256(text.encode()).hexdigest()
