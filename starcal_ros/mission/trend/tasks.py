# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations and bags below a root and the cameras they are of; `answers` makes their rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass, field
import fnmatch
import functools
import hashlib
import os
from pathlib import Path
import posixpath
import re

from starcal_ros.errors import OptionError
from starcal_ros.formats.products.calibration_json import CALIBRATION_FILE
from starcal_ros.formats.products.product_files import OBSERVATIONS_FILE, read_text
from starcal_ros.mission.trend import places
from starcal_ros.mission.trend.places import Entry
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.pipeline.setup import files_of, read_setup
from starcal_ros.text import printable
from starcal_ros.untrusted import regular_file, shown

KEPT_FOLDER = 'trend.calibrations'  # beside the table; those of bags, no source of rows
_ARCHIVED = re.compile(r'\d{8,}_calibration_\d{8,}\.json')  # of the state folder of a calibrator
_METADATA = 'metadata.yaml'
_KEYS = ('spacecraft', 'camera')
_COLUMNS = ('path', *_KEYS, 'params')
_MOST_BYTES = 8 * 2**20
_TOKEN = re.compile(r'\{(\w+)\}|(\*)|([^{}*]+)|(.)')


@dataclass(frozen=True, slots=True)
class Task:
    """
    A calibration file to read, or a bag to calibrate.

    Attributes
    ----------
    url : str
        Absolute path or URL.
    stamp : str
        Digest of name, identity and settings, none of which is read from the file: what has it is
        not read again.  Empty where the listing has no identity.
    files : tuple of str
        Those that are read, as far as the listing shows.
    size : int
        Their bytes; -1 if one could not be read when it was listed.
    is_bag : bool
    params : str
        Parameter file for a bag; empty: options and prior of the calibration beside it.
    settings : tuple of str
        Files that decide about the result of a bag as well.
    spacecraft, camera : str
        From the table or the pattern of cameras; empty: from the metadata of the bag.
    known : tuple of str
        Keys in the table of which one may be that of this content.
    """

    url: str
    stamp: str
    files: tuple[str, ...]
    size: int = 0
    is_bag: bool = False
    params: str = ''
    settings: tuple[str, ...] = ()
    spacecraft: str = ''
    camera: str = ''
    known: tuple[str, ...] = ()


def find(root: str, cameras: Cameras) -> Iterator[Task]:
    """
    Tasks below a root, as it is listed; no file is read.

    A bag is a task where it has parameters and no calibration beside it.  Observations beside a
    calibration are one too: it is done only if that is of another version.  Raises OSError when
    a folder cannot be listed. Raises StarcalError when a parameter file or a file that it names
    cannot be read.
    """
    version, settings_of = software_version(), functools.cache(_settings)
    for entries in places.listings(root):
        listed = {e.name: e for e in entries if KEPT_FOLDER not in e.name.split('/')}
        yield from _tasks(root, listed, cameras, version, settings_of)


def _tasks(
    root: str,
    listed: dict[str, Entry],
    cameras: Cameras,
    version: str,
    settings_of: Callable[[str], tuple[tuple[str, ...], str]],
) -> Iterator[Task]:
    """Tasks of files by name: calibrations in order of their paths, then bags."""
    for name, entry in listed.items():
        if posixpath.basename(name) == CALIBRATION_FILE:
            observations = listed.get(posixpath.join(posixpath.dirname(name), OBSERVATIONS_FILE))
            others = (observations,) if observations else ()
            yield _task(root, name, (entry,), cameras, others=others)
        elif _ARCHIVED.fullmatch(posixpath.basename(name)):
            yield _task(root, name, (entry,), cameras)
    for name, files in _bags(listed).items():
        folder = posixpath.dirname(name) if name in listed else name
        calibration = listed.get(posixpath.join(folder, CALIBRATION_FILE))
        params = cameras.params_of(name)
        if params and calibration is None:
            yield _task(root, name, files, cameras, version, params, settings_of(params))
        elif calibration is not None and posixpath.basename(name) == OBSERVATIONS_FILE:
            yield _task(root, name, files, cameras, version, others=(calibration,))


def _settings(params: str) -> tuple[tuple[str, ...], str]:
    """Absolute paths of a parameter file and those that it names, and their digest."""
    files = (Path(params), *files_of(read_setup(Path(params)).frames).values())
    paths = tuple(map(os.path.abspath, files))
    return paths, digest(paths)


def digest(files: Sequence[str | Path], version: str = '') -> str:
    """Digest of the contents of files, those that do not exist left out; raises OSError."""
    found = hashlib.sha256(version.encode())
    for file in files:
        if not os.path.lexists(file):
            continue  # metadata.yaml of a bag, which need not be there
        with regular_file(Path(file)) as stream:
            while block := stream.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def _task(
    root: str,
    name: str,
    files: Sequence[Entry],
    cameras: Cameras,
    version: str = '',
    params: str = '',
    settings: tuple[tuple[str, ...], str] = ((), ''),
    others: Sequence[Entry] = (),
) -> Task:
    """A task; ``version`` is that which would calibrate a bag, ``others`` are read with it."""
    # A calibration is the same whatever is beside it, a bag is not.
    decide = [*files, *(others if version else ())]
    identities = [(entry.name, entry.identity) for entry in decide]
    spacecraft, camera = map(printable, cameras.of(name))
    text = f'{identities!r} {version} {settings[1]} {spacecraft!r} {camera!r}'
    return Task(
        url=places.join(root, name),
        stamp=hashlib.sha256(text.encode()).hexdigest() if all(i for _, i in identities) else '',
        files=tuple(entry.url for entry in (*files, *others)),
        size=sum(entry.size for entry in files) if all(e.size >= 0 for e in files) else -1,
        is_bag=bool(version),
        params=params,
        settings=settings[0],
        spacecraft=spacecraft,
        camera=camera,
    )


def _bags(listed: dict[str, Entry]) -> dict[str, list[Entry]]:
    """Bag folders with a metadata.yaml, and single files elsewhere; no files of an archive."""
    found: dict[str, list[Entry]] = {}
    for name, entry in listed.items():
        folder, file = posixpath.split(name)
        # One image each: the state of a calibrator, calibrated there.
        if not file.endswith('.mcap') or posixpath.basename(folder) == 'ensemble':
            continue
        metadata = listed.get(posixpath.join(folder, _METADATA))
        if metadata and file != OBSERVATIONS_FILE:
            found.setdefault(folder, [metadata]).append(entry)
        else:
            found[name] = [entry]
    return found


@dataclass(frozen=True)
class Cameras:
    """
    Which camera a path below the root belongs to, and the parameters of that camera.

    Attributes
    ----------
    pattern : regular expression or None
        Of the start of a path, with groups for spacecraft and camera.
    table : tuple of mappings
        Rows of a table with the columns path (a pattern of shell), spacecraft, camera and params;
        the first that matches counts.
    params : str
        Parameter file, in which ``{spacecraft}`` and ``{camera}`` are replaced; may be empty.
    """

    pattern: re.Pattern[str] | None = None
    table: tuple[Mapping[str, str], ...] = field(default=(), repr=False)
    params: str = ''

    def of(self, name: str) -> tuple[str, str]:
        """Spacecraft and camera of a path below the root, empty if nothing names them."""
        found = self._row(name)
        if self.pattern and (match := self.pattern.match(name)):
            found = {**match.groupdict(), **found}
        return found.get(_KEYS[0], ''), found.get(_KEYS[1], '')

    def params_of(self, name: str) -> str:
        """Absolute path of the parameters of a bag; empty if there are none."""
        own = self._row(name).get('params', '')
        if own or not self.params:
            return own
        spacecraft, camera = self.of(name)
        text = self.params.replace('{spacecraft}', spacecraft).replace('{camera}', camera)
        return os.path.abspath(text)

    def _row(self, name: str) -> Mapping[str, str]:
        return next((row for row in self.table if fnmatch.fnmatchcase(name, row['path'])), {})


def read_cameras(text: str, params: str) -> Cameras:
    """
    Cameras by a pattern such as ``{spacecraft}/{camera}/*.mcap``, or by the path of a CSV table.

    Raises StarcalError in one line, for a pattern without a name or a table that cannot be read.
    """
    if '{' in text:
        return Cameras(pattern=_compiled(text), params=params)
    return Cameras(table=_rows(Path(text)) if text else (), params=params)


def _compiled(pattern: str) -> re.Pattern[str]:
    """Expression for the start of a path, up to the segment of the last name."""
    start = pattern[: pattern.rindex('}') + 1] if '}' in pattern else pattern
    start += pattern[len(start) :].partition('/')[0]
    found, names = '', []
    for name, star, text, other in _TOKEN.findall(start.removeprefix('./')):
        if other or (name and name not in _KEYS) or name in names:
            raise OptionError(
                f'--cameras: {shown(pattern)}: not a pattern with {{spacecraft}} and {{camera}}'
            )
        names += [name] if name else []
        found += f'(?P<{name}>[^/]+?)' if name else '[^/]*' if star else re.escape(text)
    return re.compile(f'{found}(?:/|$)')


def _rows(path: Path) -> tuple[Mapping[str, str], ...]:
    text = read_text(path, _MOST_BYTES)
    rows = csv.DictReader(text.splitlines(), restval='')
    if 'path' not in (rows.fieldnames or ()) or not set(rows.fieldnames or ()) <= {*_COLUMNS}:
        raise OptionError(f'{path}: the first line does not name columns of {", ".join(_COLUMNS)}')
    found = []
    for row in rows:
        if None in row:
            raise OptionError(f'{path}:{rows.line_num}: more values than columns')
        values = {name: value.strip() for name, value in row.items() if value.strip()}
        if 'path' not in values:
            raise OptionError(f'{path}:{rows.line_num}: no path')
        if 'params' in values:
            values['params'] = os.path.abspath(path.parent / values['params'])
        found.append(values)
    return tuple(found)
