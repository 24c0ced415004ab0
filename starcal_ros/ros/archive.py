# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
State on disk: the ensemble, and the activated calibrations, safe from a crash.

``ensemble/00000012.mcap`` is one image, numbered in order of arrival: a whole bag that any reader
of MCAP opens.  ``ensemble/refused.json`` counts the refused images and names the `Collections`.
``calibrations/00000007_calibration_00000003.json`` records that event 7 activated calibration 3
(here by a roll-back): a ``calibration.json`` with two more keys.  ``active.json`` states which of
them is active and which were withdrawn, for readers: a calibrator judges them again.

A file is written beside its place, synced, renamed, and the folder synced; it is never changed
afterwards.  So at any instant each file is complete or absent.

The folder is untrusted input.  Only regular files of limited size are opened.  A file with a wrong
seal (`Seal`), or with content that is no image or no calibration, is renamed to ``….damaged``
and skipped.  A file that cannot be read is an error, since it may be sound.  With a key, the name
of an image carries its HMAC: ``00000012_<64 digits>.mcap``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import contextlib
from dataclasses import dataclass, field, replace
import fcntl
import functools
import hashlib
import hmac
import itertools
import json
import os
from pathlib import Path
import re
import shutil
import stat
from typing import Any, TypeVar

from starcal_ros.errors import ArchiveError, BagError, errors_as, OptionError, ProductError
from starcal_ros.files import PART, sync_folder
from starcal_ros.formats.bag.typestore import observations_bag, observations_in_bag
from starcal_ros.formats.products import product_files
from starcal_ros.formats.products.product_files import ActiveFile, STATE_ACTIVE, write_atomically
from starcal_ros.formats.products.product_files import STATE_CALIBRATIONS as _CALIBRATIONS
from starcal_ros.formats.products.product_files import STATE_ENSEMBLE as _ENSEMBLE
from starcal_ros.record_fields import Count, json_object, read_record
from starcal_ros.records import Activation, counted_refusal, Ensemble, StarObservations
from starcal_ros.ros.joining import Collections
from starcal_ros.untrusted import json_value, read_bytes

ARCHIVE_SCHEMA = 1
TOPIC = '/observations'

_EMPTIED = 'ensemble.emptied'
_OWN = (_ENSEMBLE, _CALIBRATIONS, _EMPTIED)  # folders in which files are removed
_REFUSED = 'refused.json'
_EVENT_NAME = re.compile(r'(\d{8,9})_calibration_(\d{8,9})\.json')
_IMAGE_NAME = re.compile(r'(\d{8,9})(?:_([0-9a-f]{64}))?\.mcap')
# Numbers in the names of files that are not read count as given up to this one: a calibrator does
# not reach it, and a file with a longer number would leave none for those after it.
_NUMBERED = re.compile(r'\.?(\d{8})[._]')
_LAST_NUMBER = 999_999_999
_MOST_BYTES = 64 << 20  # largest file that is read: an image of 10,000 stars has 1 MB
_MOST_COUNT = 2**32 - 1  # the message counts refused images in a uint32
_LEAST_KEY_BYTES, _MOST_KEY_BYTES = 16, 4096
_CHECKSUM, _HMAC = 'sha256', 'hmac_sha256'


T = TypeVar('T')


class _WrongKey(ValueError):
    """A file is sound, but for its HMAC."""


class _OtherVersion(ValueError):
    """A file has another schema."""


@dataclass(frozen=True)
class Seal:
    """
    Seals of state files: a checksum against damage and, with a key, an HMAC against forgery.

    A checksum can be computed again by anyone who changes a file; an HMAC only with the key.
    Neither shows that an old file was put back, or that one was removed.
    """

    key: bytes = b''

    def sealed(self, content: Mapping[str, object]) -> str:
        """JSON text of an object, with its checksum and HMAC as the last keys."""
        text = _canonical(content)
        seals = {_CHECKSUM: hashlib.sha256(text).hexdigest()}
        if self.key:
            seals[_HMAC] = self._hmac(text)
        return json.dumps({**content, **seals}, indent=1, allow_nan=False) + '\n'

    def opened(self, data: bytes) -> dict[str, Any]:
        """
        The JSON object of a sealed file, without its seals.

        Raises ValueError when it is no JSON object, or a seal is missing or wrong.
        """
        content = json_value(data.decode())
        if not isinstance(content, dict):
            raise ValueError('not a JSON object')
        checksum, seal = content.pop(_CHECKSUM, None), content.pop(_HMAC, None)
        text = _canonical(content)
        if checksum != hashlib.sha256(text).hexdigest():
            raise ValueError('the checksum is wrong')
        self._check(seal, text)
        return content

    def mark(self, number: int, data: bytes) -> str:
        """HMAC of a numbered file, for its name; empty without a key."""
        return self._hmac(_numbered(number, data)) if self.key else ''

    def check_mark(self, mark: str, number: int, data: bytes) -> None:
        """
        Compare the HMAC in the name of a file with its content; does nothing without a key.

        Raises ValueError when it is missing or wrong.
        """
        self._check(mark, _numbered(number, data))

    def _check(self, seal: object, text: bytes) -> None:
        if not self.key:
            return
        if not seal:
            raise _WrongKey('the HMAC is missing (state_key_file)')
        if not hmac.compare_digest(str(seal).encode(), self._hmac(text).encode()):
            raise _WrongKey('the HMAC is wrong (state_key_file)')

    def _hmac(self, text: bytes) -> str:
        return hmac.new(self.key, text, 'sha256').hexdigest()


CHECKSUMS = Seal()
"""The seal without a key."""


def read_seal(key_file: str) -> Seal:
    """
    The seal with the key in a file; '' for checksums alone.

    Raises OptionError when the file cannot be read, or the key is too short or too long.
    """
    if not key_file:
        return Seal()
    with errors_as(OptionError, f'state_key_file: {key_file}'):
        key = read_bytes(Path(key_file), _MOST_KEY_BYTES).strip()
    if len(key) < _LEAST_KEY_BYTES:
        raise OptionError(
            f'state_key_file: {key_file} holds {len(key)} bytes, at least {_LEAST_KEY_BYTES} are '
            'needed (openssl rand -hex 32)'
        )
    return Seal(key)


def _canonical(content: Mapping[str, object]) -> bytes:
    # Numbers are written with the digits that read back to the same double, so the text is unique.
    return json.dumps(content, sort_keys=True, separators=(',', ':')).encode()


def _numbered(number: int, data: bytes) -> bytes:
    return f'{number}:'.encode() + data


@dataclass(frozen=True)
class _ActivationKeys:
    """The key ``archive`` of the file of an activation."""

    schema: int
    event: Count
    before: Count
    origin: str


@dataclass(frozen=True)
class _RefusedFile:
    """The file of the counts of refused images by reason, of collections and of the camera."""

    schema: int
    refused: Mapping[str, Count] = field(default_factory=dict)
    current: tuple[str, ...] = ()
    ended: tuple[str, ...] = ()
    camera_frame: str = ''
    star_tracker_frame: str = ''


@dataclass(frozen=True)
class _KeptImage:
    """An image on disk, and its file."""

    image: StarObservations
    path: Path


@dataclass(frozen=True)
class _KeptEvent:
    """The origin of an event on disk, and its file."""

    origin: str
    path: Path


class Archive:
    """
    A state folder, locked by this process until `close`.

    The records in memory are authoritative; `keep` writes them.  Not safe for several threads.
    Raises ArchiveError when the folder or a file in it cannot be made or read, or another process
    has locked the folder.

    Attributes
    ----------
    damage : list of str
        A sentence for each file that was set aside or skipped.
    last_event : int
        The highest number given to any file.
    """

    def __init__(
        self, folder: Path, frame_id: str, seal: Seal = CHECKSUMS, tracker_frame: str = ''
    ) -> None:
        self.folder = folder
        self._seal = seal
        self.damage: list[str] = []
        self.last_event = 0
        self._frame_id, self._tracker_frame = frame_id, tracker_frame
        self._images: dict[int, _KeptImage] = {}  # by stamp: those on disk
        self._next_image = 1
        self._counts = _RefusedFile(ARCHIVE_SCHEMA)  # on disk
        self._events: dict[int, _KeptEvent] = {}  # those on disk
        self._active: ActiveFile | None = None  # last written
        self._lock = _locked(folder)
        self._finish_emptying()
        parts = [part for own in ('', *_OWN) for part in (folder / own).glob(f'.*{PART}')]
        # That of `ros2 bag reindex` would hide the images after it from readers of the folder.
        for stale in (*parts, folder / _ENSEMBLE / 'metadata.yaml'):
            with contextlib.suppress(OSError):
                stale.unlink()

    def close(self) -> None:
        """Unlock the folder; safe to call twice."""
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def saved(self, ensemble: Ensemble) -> int:
        """Number of images of an ensemble on disk."""
        return sum(map(self._holds, ensemble.images)) if self.is_in_place() else 0

    def is_in_place(self) -> bool:
        """True while the path leads to the folder that is locked, which may be replaced."""
        with contextlib.suppress(OSError):
            return os.path.samestat(os.fstat(self._lock), self.folder.stat())
        return False

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

    @property
    def collections(self) -> Collections:
        """The collections of the images on disk."""
        return Collections(self._counts.current, self._counts.ended)

    @property
    def frames(self) -> tuple[str, str]:
        """Camera and star tracker of the images on disk; empty where it is not recorded."""
        return self._counts.camera_frame, self._counts.star_tracker_frame

    def read_ensemble(self) -> Ensemble:
        """The ensemble on disk, in order of arrival; damaged images are set aside."""
        self._check_key()
        images: dict[int, _KeptImage] = {}
        for path, name in self._files(_ENSEMBLE, _IMAGE_NAME):
            image = self._read(path, functools.partial(self._image, name))
            if image is not None and image.time_ns not in images:
                images[image.time_ns] = _KeptImage(image, path)
                self._next_image = max(self._next_image, int(name[1]) + 1)
        for path, _ in self._files(_ENSEMBLE, re.compile(re.escape(_REFUSED))):
            counts = self._read(path, lambda data: _counts(self._opened(data, ARCHIVE_SCHEMA)))
            self._counts = counts or _RefusedFile(ARCHIVE_SCHEMA)
        self._images = images
        refused = dict(self._counts.refused)
        return Ensemble(tuple(kept.image for kept in images.values()), refused)

    def _check_key(self) -> None:
        """Raise ArchiveError where files are sound, but none of them has a seal of the key."""
        unsealed = 0
        for own, pattern in ((_ENSEMBLE, _IMAGE_NAME), (_CALIBRATIONS, _EVENT_NAME)):
            for path in sorted((self.folder / own).glob('*')):
                name = pattern.fullmatch(path.name)
                if name is None or not stat.S_ISREG(path.lstat().st_mode):
                    continue
                try:
                    self._check_seal(path, name)
                    return
                except _WrongKey:
                    unsealed += 1
                except ValueError:  # damaged: it is set aside when it is read
                    continue
        if unsealed:
            raise ArchiveError(
                f'state_dir: no file of {self.folder} has an HMAC of state_key_file, but '
                f'{unsealed} are sound: give the key that they were written with, or another '
                'state_dir'
            )

    def _check_seal(self, path: Path, name: re.Match[str]) -> None:
        data = _content(path)
        if path.suffix == '.json':
            self._seal.opened(data)
        elif self._seal.key:
            _image_of(data)
            self._seal.check_mark(name[2] or '', int(name[1]), data)

    def set_aside_image(self, time_ns: int, why: str) -> None:
        """Rename the file of an image that cannot be used, so that it is not read again."""
        if kept := self._images.pop(time_ns, None):
            self._set_aside(kept.path, why)

    def read_history(self) -> tuple[Activation, ...]:
        """
        The activations on disk, in order, not judged by any gate.

        Where the last is damaged, another file of the same calibration replaces it, else the event
        before.
        """
        history: dict[str, Activation] = {}
        last_number = 0
        for path, name in self._files(_CALIBRATIONS, _EVENT_NAME):
            last_number = int(name[2])
            record = self._read(path, functools.partial(self._event, name))
            if record is not None:
                # A kill while a joined history was written leaves an event with two numbers.
                history.pop(record.origin, None)
                history[record.origin] = record
                self._events[record.event] = _KeptEvent(record.origin, path)
                self.last_event = max(self.last_event, record.event)
        records = list(history.values())
        same = [record for record in records if record.calibration.number == last_number]
        if same and records[-1].calibration.number != last_number:
            records.append(Activation(self.last_event, same[-1].before, same[-1].calibration))
        return tuple(records)

    def keep(
        self,
        ensemble: Ensemble,
        history: tuple[Activation, ...],
        collections: Collections | None = None,
    ) -> None:
        """
        Make the folder hold these; returns at once where it holds them already.

        A new image costs one file.  Where all collections on disk have ended, their images are
        removed first, in one step.  Without ``collections`` those on disk stay.  Raises
        ArchiveError when writing fails, or the folder is another than the one that is locked; the
        files on disk are intact then, and the next call continues.
        """
        if not self.is_in_place():
            raise ArchiveError(
                f'state_dir: {self.folder} was removed or replaced; put it back or configure again'
            )
        stamps = {image.time_ns for image in ensemble.images}
        collections = collections or self.collections
        try:
            # The last one is active, also after a kill between two of them.
            for record in reversed(history):
                self._keep_event(record)
            if not self.collections.survives(collections):
                self._empty()
            # Before the images: a reset of some collections must not drop images of others.
            self._keep_counts(ensemble, collections)
            for image in ensemble.images:
                if not self._holds(image):
                    self._keep_image(image)
        except ProductError as error:
            raise ArchiveError(f'state_dir: {error}') from error
        except OSError as error:
            raise ArchiveError(
                f'state_dir: {error.filename or self.folder}: {error.strerror}'
            ) from error
        finally:  # on a full disk, removed files make room for the next call
            self._drop(stamps, history)

    def keep_active(self, active: Activation | None, withdrawn: tuple[str, ...]) -> None:
        """
        State which activation is active, and why others are not; `keep` must have kept them.

        Raises ArchiveError when the file cannot be written.
        """
        if not self._events:
            return
        path = self._events[active.event].path.relative_to(self.folder) if active else ''
        stated = ActiveFile(ARCHIVE_SCHEMA, self.last_event, str(path), withdrawn)
        if stated == self._active:
            return
        try:
            write_atomically(self.folder / STATE_ACTIVE, self._seal.sealed(json_object(stated)))
        except ProductError as error:
            raise ArchiveError(f'state_dir: {error}') from error
        self._active = stated

    def _keep_event(self, record: Activation) -> None:
        if record.event in self._events:
            return
        _check_number(record.event)
        keys = _ActivationKeys(ARCHIVE_SCHEMA, record.event, record.before, record.origin)
        content = {
            **product_files.calibration_content(record.calibration),
            'archive': json_object(keys),
        }
        number = record.calibration.number
        name = f'{record.event:08d}_calibration_{number:08d}.json'
        path = self._write(_CALIBRATIONS, name, self._seal.sealed(content).encode())
        self._events[record.event] = _KeptEvent(record.origin, path)
        self.last_event = max(self.last_event, record.event)

    def _keep_counts(self, ensemble: Ensemble, collections: Collections) -> None:
        counts = _RefusedFile(
            ARCHIVE_SCHEMA,
            dict(ensemble.refused),
            collections.current,
            collections.ended,
            self._frame_id,
            self._tracker_frame,
        )
        is_needed = ensemble.images or ensemble.refused or collections.ended
        if counts == self._counts or not is_needed:
            return
        self._write(_ENSEMBLE, _REFUSED, self._seal.sealed(json_object(counts)).encode())
        self._counts = counts

    def _keep_image(self, image: StarObservations) -> None:
        number = self._next_image
        _check_number(number)
        stale = self._images.get(image.time_ns)
        try:
            data = observations_bag(TOPIC, image, self._frame_id)
            is_same = stale and data == observations_bag(TOPIC, stale.image, self._frame_id)
        except BagError as error:
            raise ArchiveError(f'state_dir: image of {image.time_ns} ns: {error}') from error
        if stale is not None and is_same:  # read anew since it was written
            self._images[image.time_ns] = _KeptImage(image, stale.path)
            return
        mark = self._seal.mark(number, data)
        name = f'{number:08d}_{mark}.mcap' if mark else f'{number:08d}.mcap'
        path = self._write(_ENSEMBLE, name, data)
        self._images[image.time_ns] = _KeptImage(image, path)
        self._next_image += 1
        if stale is not None:
            stale.path.unlink(missing_ok=True)

    def _write(self, folder: str, name: str, data: bytes) -> Path:
        if len(data) > _MOST_BYTES:
            raise ArchiveError(
                f'state_dir: {name} not written, its {len(data)} bytes are more than a start '
                f'reads, {_MOST_BYTES}; drop the images with ~/reset'
            )
        path = self.folder / folder / name
        if not path.parent.is_dir():
            path.parent.mkdir()
            sync_folder(self.folder)
        write_atomically(path, data)
        return path

    def _drop(self, stamps: set[int], history: tuple[Activation, ...]) -> None:
        for stamp in self._images.keys() - stamps:
            with contextlib.suppress(OSError):
                self._images[stamp].path.unlink(missing_ok=True)
                del self._images[stamp]
        # An event whose file with another number is not written yet stays in the old file.
        unwritten = {record.origin for record in history if record.event not in self._events}
        for event in self._events.keys() - {record.event for record in history}:
            if self._events[event].origin in unwritten:
                continue
            with contextlib.suppress(OSError):
                self._events[event].path.unlink(missing_ok=True)
                del self._events[event]

    def _empty(self) -> None:
        self._finish_emptying()
        (self.folder / _ENSEMBLE).rename(self.folder / _EMPTIED)
        self._images.clear()
        self._counts = _RefusedFile(ARCHIVE_SCHEMA)
        sync_folder(self.folder)
        self._finish_emptying()

    def _finish_emptying(self) -> None:
        """Remove the images of an emptied ensemble; other files, those set aside too, stay."""
        emptied = self.folder / _EMPTIED
        with contextlib.suppress(OSError):
            for path in list(emptied.iterdir()):
                if (
                    _IMAGE_NAME.fullmatch(path.name)
                    or path.name == _REFUSED
                    or path.name.endswith(PART)
                ):
                    path.unlink()
                else:
                    (self.folder / _ENSEMBLE).mkdir(exist_ok=True)
                    path.rename(_free_name(self.folder / _ENSEMBLE / path.name))
            emptied.rmdir()

    def _files(
        self, folder: str, pattern: re.Pattern[str]
    ) -> Iterator[tuple[Path, re.Match[str]]]:
        """Regular files with a name, in its order; the highest number of any file is kept."""
        try:
            names = sorted(path.name for path in (self.folder / folder).iterdir())
        except FileNotFoundError:
            return
        except OSError as error:
            raise _unreadable(self.folder / folder, error) from error
        highest = max((int(n[1]) for n in map(_NUMBERED.match, names) if n), default=0)
        if folder == _ENSEMBLE:
            self._next_image = max(self._next_image, highest + 1)
        else:
            self.last_event = max(self.last_event, highest)
        for name in names:
            match = pattern.fullmatch(name)
            if match is None:
                continue
            path = self.folder / folder / name
            try:
                is_file = stat.S_ISREG(path.lstat().st_mode)
            except OSError as error:
                raise _unreadable(path, error) from error
            if is_file:
                yield path, match
            else:
                self.damage.append(f'{path}: not a regular file, skipped')

    def _read(self, path: Path, reader: Callable[[bytes], T]) -> T | None:
        """Content of a file by its reader; None where it is set aside, or of another version."""
        try:
            return reader(_content(path))
        except _OtherVersion:
            self.damage.append(f'{path}: of another version, skipped')
        except (ProductError, ValueError) as error:
            self._set_aside(path, str(error))
        return None

    def _image(self, name: re.Match[str], data: bytes) -> StarObservations:
        self._seal.check_mark(name[2] or '', int(name[1]), data)
        return _image_of(data)

    def _event(self, name: re.Match[str], data: bytes) -> Activation:
        content = self._opened(data, product_files.SCHEMA)
        archive = content.get('archive')
        if not isinstance(archive, dict) or archive.get('schema') != ARCHIVE_SCHEMA:
            raise _OtherVersion
        return _activation(content, int(name[1]), int(name[2]))

    def _opened(self, data: bytes, schema: int) -> Mapping[str, Any]:
        """The JSON object of a file with the right seals and this schema."""
        content = self._seal.opened(data)
        if content.get('schema') != schema:
            raise _OtherVersion
        return content

    def _set_aside(self, path: Path, why: str) -> None:
        aside = _free_name(path.with_name(f'{path.name}.damaged'))
        with contextlib.suppress(OSError):  # on a read-only disk it is skipped where it is
            path.rename(aside)
        self.damage.append(f'{aside}: damaged, set aside: {" ".join(why.split())}')


def _activation(content: Mapping[str, Any], event: int, number: int) -> Activation:
    """The activation in the JSON object of its file; raises ProductError or ValueError."""
    keys = read_record(_ActivationKeys, content['archive'], 'archive')
    calibration = product_files.calibration_from_content(Path(_CALIBRATIONS), content)
    if (keys.event, calibration.number) != (event, number):
        raise ValueError(f'is event {keys.event} of calibration {calibration.number}')
    if keys.before >= event:
        raise ValueError(f'archive.before: {keys.before} is not before {event}')
    return Activation(event, keys.before, calibration, keys.origin)


def _counts(content: Mapping[str, Any]) -> _RefusedFile:
    """The counts in the JSON object of their file, of reasons of this version."""
    read = read_record(_RefusedFile, content)
    refused: dict[str, int] = {}
    for name, count in read.refused.items():
        reason = counted_refusal(name)
        refused[reason] = refused.get(reason, 0) + count
    if sum(refused.values()) > _MOST_COUNT:
        raise ValueError(f'refused: more than {_MOST_COUNT} images')
    return replace(read, refused=refused)


def _image_of(data: bytes) -> StarObservations:
    """The image in the bytes of a file; raises ValueError for damage."""
    try:
        image = observations_in_bag(data)
    except BagError as error:
        raise ValueError(str(error)) from error
    if image.refusal:
        raise ValueError(f'{image.refusal}: {image.detail}')
    return image


def _content(path: Path) -> bytes:
    """Content of a state file; raises ValueError for damage, ArchiveError if it is not known."""
    try:
        return read_bytes(path, _MOST_BYTES, follow_links=False)
    except OSError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: OSError) -> ArchiveError:
    remedy = 'start the calibrator as the user who owns it, or move it to another place'
    return ArchiveError(f'state_dir: {path} cannot be read: {error.strerror}; {remedy}')


def _free_name(path: Path) -> Path:
    """The path, with a number after it where a file is there already."""
    names = itertools.chain(
        [path], (path.with_name(f'{path.name}{k}') for k in itertools.count(2))
    )
    return next(name for name in names if not os.path.lexists(name))


def _check_number(number: int) -> None:
    if number > _LAST_NUMBER:
        raise ArchiveError(
            f'state_dir: number {number} has too many digits; move the files with the highest '
            'numbers to another place'
        )


def _locked(folder: Path) -> int:
    """Descriptor with a lock on the folder, which the system releases when the process ends."""
    number = -1
    try:
        folder.mkdir(parents=True, exist_ok=True)
        number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        for path in (folder / own for own in _OWN):
            # The target of a link may belong to somebody else.
            if os.path.lexists(path) and not stat.S_ISDIR(path.lstat().st_mode):
                raise NotADirectoryError(0, 'not a folder; move it to another place', f'{path}')
    except OSError as error:
        if number >= 0:
            os.close(number)
        if isinstance(error, BlockingIOError):
            raise ArchiveError(f'state_dir: {folder} is in use by another calibrator') from error
        if isinstance(error, PermissionError):
            raise _unreadable(folder, error) from error
        raise ArchiveError(f'state_dir: {error.filename or folder}: {error.strerror}') from error
    return number
