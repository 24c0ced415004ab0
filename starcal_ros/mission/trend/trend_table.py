# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The Parquet table of a trend: a folder of files, each written whole, that grows without a rewrite.

``spacecraft=S/camera=C/*.parquet`` has the rows of a camera; ``_new`` those of a run that has not
ended, which are sorted in at its end or after 256 files; ``_seen`` the stamps of files whose row
is that of another file.  Readers of Parquet skip folders whose names start with an underscore.

A crash leaves complete files only.  Rows are unique by their key; of several the newest counts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
import dataclasses
import posixpath
import time
from typing import Any, get_type_hints
import urllib.parse
import uuid

import pyarrow as pa
import pyarrow.parquet as pq

from starcal_ros.errors import ProductError
from starcal_ros.mission.trend import places
from starcal_ros.mission.trend.answers import Seen, START
from starcal_ros.mission.trend.rows import Row
from starcal_ros.mission.trend.tasks import Task
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.record_codec import json_object, read_record

TABLE_FOLDER = 'trend.parquet'
SCHEMA_VERSION = '2'  # in the metadata of each file as `starcal_trend_schema`; 1 has none
PARTITIONS = ('spacecraft', 'camera')
_NEW, _SEEN = '_new', '_seen'
_NONE = '-'  # a value must be there: readers infer the type of a column from it
_BATCH = 16  # rows in a part: what a crash can lose, a few seconds of work
_MERGE = 256  # parts from which they are sorted in
_MOST_KNOWN = 1000  # digests of a size sent with a task: beyond, the content is used again
_MOST_BYTES = 256 * 2**20  # of a file; a row has 1 kB
_MOST_VALUES = 2**25  # of a file, repeated ones counted, which compress to nothing
_TYPES: dict[Any, pa.DataType] = {
    str: pa.string(),
    int: pa.int64(),
    bool: pa.bool_(),
    float: pa.float64(),
    tuple[str, ...]: pa.list_(pa.string()),
    tuple[float, ...]: pa.list_(pa.float64()),
}
_FIELDS = {field.name: field for field in dataclasses.fields(Row)}
SCHEMA = pa.schema(
    [(name, _TYPES[kind]) for name, kind in get_type_hints(Row).items() if name in _FIELDS],
    metadata={'starcal_trend_schema': SCHEMA_VERSION},
)
_SEEN_SCHEMA = pa.schema([('stamp', pa.string()), ('key', pa.string())])
_STATE = ('key', 'path', 'stamp', 'size_bytes', 'error', 'software', 'is_passing', *PARTITIONS)


@dataclasses.dataclass(frozen=True)
class _Known:
    """Part of a row that is kept in memory."""

    part: str
    stamp: str
    camera: tuple[str, str]
    failed_with: str  # the software; empty: it has not failed
    is_passing: bool


class Table:
    """
    The table in a folder; rows are added one by one and written in batches.

    Use it in a ``with`` statement: its end writes the last batch and sorts the rows in. Raises
    ProductError when a file of the table cannot be read or written.
    """

    def __init__(self, folder: object) -> None:
        self.folder = places.join(places.absolute(str(folder)), TABLE_FOLDER)
        self._pending: list[Row] = []
        self._pending_seen: dict[str, str] = {}
        self._known: dict[str, _Known] = {}
        self._stamps: dict[str, str] = {}
        self._starts: dict[str, list[str]] = {}  # of digests, by size; by path of earlier versions
        self._left: set[str] = set()  # folders of cameras that a row has left
        self._new_parts = 0
        try:
            places.make_folder(self.folder)
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be created: {error.strerror}') from error
        for part in self._parts():
            self._note(part)
        self._note_seen()

    def __enter__(self) -> Table:
        """Return the table."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write the rows that are held in memory, and sort them in."""
        self.flush()
        self._sort_in()

    def __contains__(self, key: object) -> bool:
        """True if a row with a key was added."""
        return key in self._known

    def has(self, task: Task) -> bool:
        """True if a task has its row, or needs none."""
        return task.stamp in self._stamps

    def start_of(self, task: Task) -> str:
        """Start of the key of the row of a task; empty where none is due."""
        return self._stamps[task.stamp]

    def likely(self, task: Task) -> tuple[str, ...]:
        """Starts of the digests of rows whose content may be that of a task."""
        found = [*self._starts.get(str(task.size), ()), *self._starts.get(task.url, ())]
        same = [key for key in found if key in self._known and self._is_of(task, key)]
        return tuple(key[:START] for key in same) if len(same) <= _MOST_KNOWN else ()

    def _is_of(self, task: Task, key: str) -> bool:
        """True if a row has the names of its task; the metadata of a bag may add some."""
        names = zip((task.spacecraft, task.camera), self._known[key].camera, strict=True)
        return all(given in ('', name) for given, name in names)

    def add(self, row: Row) -> bool:
        """Add a row, and return whether it is new: none with its key is of the same camera."""
        before, camera = self._known.get(row.key), (row.spacecraft, row.camera)
        if before and before.camera == camera:
            self.add_seen(row.stamp, Seen(row.key))
            return False
        if before:
            self._left.add(_folder_of(*before.camera))
        failed_with = row.software if row.error else ''
        self._known[row.key] = _Known('', row.stamp, camera, failed_with, row.is_passing)
        self._index(row.key, row.stamp, row.size_bytes, row.path)
        self._pending.append(row)
        if len(self._pending) >= _BATCH:
            self.flush()
        return True

    def add_seen(self, stamp: str, seen: Seen) -> None:
        """Note that a stamp is that of another row, or needs none."""
        if stamp:
            self._stamps[stamp] = self._pending_seen[stamp] = seen.key[:START]

    def flush(self) -> None:
        """Write what is held in memory, and sort the parts in if there are many."""
        if self._pending:
            rows = [json_object(row) for row in self._pending]
            self._write(_NEW, pa.Table.from_pylist(rows, SCHEMA))
            self._pending = []
            self._new_parts += 1
        if self._pending_seen:
            lines = [{'stamp': s, 'key': key} for s, key in self._pending_seen.items()]
            self._write(_SEEN, pa.Table.from_pylist(lines, _SEEN_SCHEMA))
            self._pending_seen = {}
        if self._new_parts >= _MERGE:
            self._sort_in()

    def forget_failed(self, but: Collection[str] = ()) -> None:
        """Remove failures, but lasting ones of some stamps that this version has tried."""
        software = f'starcal {software_version()}'
        gone = {
            key: row
            for key, row in self._known.items()
            if row.failed_with
            and (row.is_passing or row.stamp not in but or row.failed_with != software)
        }
        for part in {row.part for row in gone.values()}:
            left = self._arrow(part)
            self._write(_folder(part, self.folder), _without(left, gone))
            self._remove(part)
        for key, row in gone.items():
            del self._known[key]
            self._stamps.pop(row.stamp, None)
        starts = {key[:START] for key in gone}
        self._stamps = {s: key for s, key in self._stamps.items() if key not in starts}

    def rows(self) -> list[Row]:
        """All rows on disk, in order of time."""
        found: dict[str, Row] = {}
        for part in self._parts():
            with _naming(part):
                found |= {row.key: row for row in self._rows_of(part)}
        return sorted(found.values(), key=lambda row: (row.time_ns, row.key))

    def _rows_of(self, part: str) -> Iterator[Row]:
        """Rows of a file, which need not be one of ours."""
        camera = _camera_of(part, self.folder)
        for batch in _opened(part).iter_batches(_BATCH):
            for content in batch.to_pylist():
                yield read_record(Row, {**content, **camera})

    def _parts(self) -> list[str]:
        """Files with rows: those of version 1, then the sorted ones, then the new ones."""
        try:
            found = [e for e in places.entries(self.folder) if e.name.endswith('.parquet')]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be read: {error.strerror}') from error
        found = [entry for entry in found if not entry.name.startswith(f'{_SEEN}/')]
        rank = {_NEW: 2, '': 0}
        found.sort(key=lambda e: (rank.get(posixpath.dirname(e.name), 1), e.name))
        return [places.join(self.folder, entry.name) for entry in found]

    def _note(self, part: str) -> None:
        """Note the keys of a file in memory."""
        camera = _camera_of(part, self.folder)
        with _naming(part):
            file = _opened(part)
            there = [name for name in _STATE if name in file.schema_arrow.names]
            for row in file.read(there).to_pylist():
                row = {**_EMPTY_STATE, **row, **camera}
                who = (str(row['spacecraft']), str(row['camera']))
                failed_with = str(row['software'] or '-') if row['error'] else ''
                key, stamp = str(row['key']), str(row['stamp'])
                self._known[key] = _Known(part, stamp, who, failed_with, bool(row['is_passing']))
                self._index(key, stamp, int(row['size_bytes']), str(row['path']))
        self._new_parts += _folder(part, self.folder) == _NEW

    def _index(self, key: str, stamp: str, size: int, path: str) -> None:
        if stamp:
            self._stamps[stamp] = key[:START]
        self._starts.setdefault(str(size) if size else path, []).append(key)

    def _note_seen(self) -> None:
        starts = {key[:START] for key in self._known}
        for part in self._seen_parts():
            with _naming(part):
                for line in _opened(part).read().to_pylist():
                    if not line['key'] or line['key'] in starts:
                        self._stamps.setdefault(line['stamp'], line['key'])

    def _seen_parts(self) -> list[str]:
        folder = places.join(self.folder, _SEEN)
        try:
            return [entry.url for entry in places.entries(folder)]
        except FileNotFoundError:
            return []

    def _sort_in(self) -> None:
        """Move new rows into the files of their cameras."""
        parts = self._parts()
        new = [part for part in parts if _folder(part, self.folder) in ('', _NEW)]
        if new:
            table = pa.concat_tables([self._arrow(part) for part in new])
            newest = {key: k for k, key in enumerate(table['key'].to_pylist())}
            table = table.take(pa.array(sorted(newest.values())))
            self._replace(table, [part for part in parts if part not in new])
            for part in new:
                self._remove(part)
        seen = self._seen_parts()
        if len(seen) > 1:
            with _naming(seen[0]):
                merged = pa.concat_tables([_opened(part).read() for part in seen])
            self._write(_SEEN, merged)
            for part in seen:
                self._remove(part)
        self._new_parts = 0
        self._left = set()

    def _replace(self, new: pa.Table, parts: list[str]) -> None:
        """Write the files of the cameras of new rows, with the old rows that these leave."""
        keys = set(new['key'].to_pylist())
        cameras = list(zip(*(new[name].to_pylist() for name in PARTITIONS), strict=True))
        rows: dict[str, list[int]] = {}
        for k, who in enumerate(cameras):
            rows.setdefault(_folder_of(*who), []).append(k)
        old: dict[str, list[str]] = {folder: [] for folder in rows}
        for part in parts:
            folder = _folder(part, self.folder)
            if folder in old or folder in self._left:
                old.setdefault(folder, []).append(part)
        for folder, before in old.items():
            left = [self._arrow(part) for part in before]
            own = new.take(pa.array(rows.get(folder, []), pa.int64()))
            self._write(folder, pa.concat_tables([*(_without(t, keys) for t in left), own]))
            for part in before:
                self._remove(part)

    def _arrow(self, part: str) -> pa.Table:
        """A file with all columns of the schema, those of its folder and new ones added."""
        camera = _camera_of(part, self.folder)
        with _naming(part):
            table = _opened(part).read()
            columns = []
            for field in SCHEMA:
                if field.name in camera:
                    column = pa.array([camera[field.name]] * len(table), field.type)
                elif field.name in table.column_names:
                    column = table[field.name].cast(field.type)
                else:
                    column = pa.array([_default(field.name)] * len(table), field.type)
                columns.append(column)
            return pa.table(columns, schema=SCHEMA)

    def _write(self, folder: str, table: pa.Table) -> None:
        if not len(table):
            return
        if '=' in folder:
            table = table.drop_columns(list(PARTITIONS))
        memory = pa.BufferOutputStream()
        pq.write_table(table, memory)
        name = f'{time.time_ns():020d}-{uuid.uuid4().hex[:8]}.parquet'  # in order of time
        url = places.join(self.folder, f'{folder}/{name}')
        try:
            places.write(url, memory.getvalue().to_pybytes())
        except OSError as error:
            raise ProductError(f'{url}: cannot be written: {error.strerror}') from error
        if folder != _SEEN:
            for key in table['key'].to_pylist():
                if key in self._known:
                    self._known[key] = dataclasses.replace(self._known[key], part=url)

    def _remove(self, part: str) -> None:
        try:
            places.remove(part)
        except OSError as error:
            raise ProductError(f'{part}: cannot be removed: {error.strerror}') from error


class _naming:
    """Turns whatever reading a file raises into one line with its name."""

    def __init__(self, part: str) -> None:
        self._part = part

    def __enter__(self) -> None:
        """Do nothing."""

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> None:
        """Raise ProductError; the exceptions of damaged Parquet have no common base class."""
        if isinstance(error, Exception):
            words = ' '.join(str(error).split())[:120]
            raise ProductError(
                f'{self._part}: not a table of starcal trend: {words}; remove the file to make '
                'its rows again'
            ) from error


def _opened(part: str) -> pq.ParquetFile:
    file = pq.ParquetFile(pa.BufferReader(places.read(part, _MOST_BYTES)))
    groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
    if sum(g.column(k).num_values for g in groups for k in range(g.num_columns)) > _MOST_VALUES:
        raise ValueError(f'more than {_MOST_VALUES} values')
    return file


def _without(table: pa.Table, keys: Collection[str]) -> pa.Table:
    kept = [k for k, key in enumerate(table['key'].to_pylist()) if key not in keys]
    return table.take(pa.array(kept, pa.int64()))


def _default(name: str) -> Any:
    default = _FIELDS[name].default
    if default is dataclasses.MISSING:
        raise ValueError(f'column {name} is missing')
    return default


_EMPTY_STATE = {name: _default(name) for name in _STATE if name not in ('key', 'path')}


def _folder(part: str, root: str) -> str:
    """Folder of a file below the table."""
    return posixpath.dirname(part.removeprefix(root).lstrip('/'))


def _folder_of(*camera: str) -> str:
    """Folder of a camera in the form of Hive, which readers of Parquet take columns from."""
    values = [urllib.parse.quote(value, safe=' ') or _NONE for value in camera]
    return '/'.join(f'{name}={value}' for name, value in zip(PARTITIONS, values, strict=True))


def _camera_of(part: str, root: str) -> dict[str, str]:
    """Columns that the folder of a file has; empty for a new one."""
    pairs = [name.partition('=') for name in _folder(part, root).split('/')]
    if tuple(name for name, _, _ in pairs) != PARTITIONS:
        return {}
    return {n: '' if v == _NONE else urllib.parse.unquote(v) for n, _, v in pairs}
