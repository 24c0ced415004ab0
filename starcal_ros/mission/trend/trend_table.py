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
import contextlib
import dataclasses
import itertools
import posixpath
import time
from typing import Any, get_type_hints
import urllib.parse
import uuid

import pyarrow as pa
import pyarrow.parquet as pq

from starcal_ros.errors import ProductError
from starcal_ros.mission.trend import places
from starcal_ros.mission.trend.answers import Seen
from starcal_ros.mission.trend.rows import folder_of, NO_NAME, PARTITIONS, Row, START
from starcal_ros.mission.trend.tasks import Task
from starcal_ros.pipeline.provenance import software_version
from starcal_ros.record_codec import json_object, read_record

TABLE_FOLDER = 'trend.parquet'
SCHEMA_VERSION = '2'  # in the metadata of each file as `starcal_trend_schema`; 1 has none
_NEW, _SEEN = '_new', '_seen'
_BATCH = 16  # rows in a part: what a crash can lose, a few seconds of work
_READ = 1024  # rows at a time, which take a few MB as Python objects
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
_DEFAULTS = {
    field.name: field.default
    for field in dataclasses.fields(Row)
    if field.default is not dataclasses.MISSING
}
SCHEMA = pa.schema(
    [(name, _TYPES[kind]) for name, kind in get_type_hints(Row).items()],
    metadata={'starcal_trend_schema': SCHEMA_VERSION},
)
_SEEN_SCHEMA = pa.schema([('stamp', pa.string()), ('key', pa.string())])
_STATE = ('key', 'path', 'stamp', 'size_bytes', 'error', 'software', 'is_passing', *PARTITIONS)


@dataclasses.dataclass(frozen=True, slots=True)
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
        self._keys: dict[str, list[str]] = {}  # by part
        self._stamps: dict[str, str] = {}
        self._by_size: dict[int, list[str]] = {}
        self._new_parts = 0
        try:
            places.make_folder(self.folder)
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be created: {error.strerror}') from error
        parts, seen = self._parts()
        for part in parts:
            self._note(part)
        self._note_seen(seen)

    def __enter__(self) -> Table:
        """Return the table."""
        return self

    def __exit__(self, *_: object) -> None:
        """Write the rows that are held in memory, and sort them in."""
        self.flush()
        self._sort_in()

    def start_of(self, task: Task) -> str | None:
        """Start of the key of the row of a task; empty where none is due, None if not known."""
        return self._stamps.get(task.stamp)

    def likely(self, task: Task) -> tuple[str, ...]:
        """Starts of the digests of rows whose content may be that of a task."""
        same = self._by_size.get(task.size, ())
        found = [key[:START] for key in same if key in self._known and self._is_of(task, key)]
        return tuple(found) if len(found) <= _MOST_KNOWN else ()

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
        failed_with = row.software if row.error else ''
        self._known[row.key] = _Known('', row.stamp, camera, failed_with, row.is_passing)
        self._index(row.key, row.stamp, row.size_bytes)
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
        for key, row in gone.items():
            del self._known[key]
            self._stamps.pop(row.stamp, None)
        starts = {key[:START] for key in gone}
        self._stamps = {s: key for s, key in self._stamps.items() if key not in starts}
        if gone:
            self._sort_in()

    def rows(self) -> list[Row]:
        """All rows on disk, in order of time."""
        return sorted(itertools.chain(*self.cameras()), key=lambda row: (row.time_ns, row.key))

    def cameras(self) -> Iterator[list[Row]]:
        """Rows on disk of one camera after the other, each in order of time."""
        parts = self._parts()[0]
        for part in parts:
            if part not in self._keys:
                self._note(part)
        found: dict[str, list[Row]] = {}
        of_camera: dict[str, list[str]] = {}
        for part in parts:
            if self._camera_of(part):
                of_camera.setdefault(self._folder(part), []).append(part)
                continue
            for row in self._rows_of(part):  # not sorted in: of version 1, or of another run
                found.setdefault(folder_of(row.spacecraft, row.camera), []).append(row)
        for folder in sorted({*found, *of_camera}):
            rows = found.pop(folder, [])
            for part in of_camera.get(folder, ()):
                rows += self._rows_of(part)
            yield sorted(rows, key=lambda row: (row.time_ns, row.key))

    def camera_count(self) -> int:
        """Number of cameras by their names."""
        return len({row.camera for row in self._known.values()})

    def _rows_of(self, part: str) -> list[Row]:
        """Rows of a file that count."""
        camera, rows = self._camera_of(part), []
        with _naming(part):
            for batch in _opened(part).iter_batches(_READ):
                rows += [read_record(Row, {**one, **camera}) for one in batch.to_pylist()]
        return [row for row in rows if self._known[row.key].part == part]

    def _parts(self) -> tuple[list[str], list[str]]:
        """Files with rows: those of version 1, the sorted ones, the new ones; those of stamps."""
        try:
            found = [entry.url for entry in places.entries(self.folder)]
        except FileNotFoundError:
            return [], []
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be read: {error.strerror}') from error
        parts = [url for url in found if url.endswith('.parquet') and self._folder(url) != _SEEN]
        rank = {'': 0, _NEW: 2}
        parts.sort(key=lambda url: (rank.get(self._folder(url), 1), url))
        return parts, [url for url in found if self._folder(url) == _SEEN]

    def _note(self, part: str) -> None:
        """Note the keys of a file in memory."""
        camera = self._camera_of(part)
        with _naming(part):
            file = _opened(part)
            there = [name for name in _STATE if name in file.schema_arrow.names]
            for row in file.read(there).to_pylist():
                row = {**_DEFAULTS, **row, **camera}
                who = (str(row['spacecraft']), str(row['camera']))
                failed_with = str(row['software'] or '-') if row['error'] else ''
                key, stamp = str(row['key']), str(row['stamp'])
                self._known[key] = _Known(part, stamp, who, failed_with, bool(row['is_passing']))
                self._keys.setdefault(part, []).append(key)
                self._index(key, stamp, int(row['size_bytes']))
        self._new_parts += self._folder(part) == _NEW

    def _index(self, key: str, stamp: str, size: int) -> None:
        if stamp:
            self._stamps[stamp] = key[:START]
        self._by_size.setdefault(size, []).append(key)

    def _note_seen(self, parts: list[str]) -> None:
        starts = {key[:START] for key in self._known}
        for part in parts:
            with _naming(part):
                for line in _opened(part).read().to_pylist():
                    if not line['key'] or line['key'] in starts:
                        self._stamps.setdefault(line['stamp'], line['key'])

    def _sort_in(self) -> None:
        """Write new rows into the files of their cameras; rows that are gone are left out."""
        parts, seen = self._parts()
        parts = [part for part in parts if part in self._keys]  # others are of another run
        new = {part for part in parts if self._folder(part) in ('', _NEW)}
        grow = {folder_of(*row.camera) for row in self._known.values() if row.part in new}
        old = [
            part
            for part in parts
            if part in new or self._folder(part) in grow or not self._is_current(part)
        ]
        if old:
            rows = pa.concat_tables([self._current_rows(part) for part in old])
            cameras = zip(*(rows[name].to_pylist() for name in PARTITIONS), strict=True)
            of_camera: dict[str, list[int]] = {}
            for k, camera in enumerate(cameras):
                of_camera.setdefault(folder_of(*camera), []).append(k)
            for folder, own in of_camera.items():
                self._write(folder, rows.take(own))
        if len(seen) > 1:
            with _naming(seen[0]):
                merged = pa.concat_tables([_opened(part).read() for part in seen])
            self._write(_SEEN, merged)
            old += seen
        for part in old:
            try:
                places.remove(part)
            except OSError as error:
                raise ProductError(f'{part}: cannot be removed: {error.strerror}') from error
        self._new_parts = 0

    def _is_current(self, part: str) -> bool:
        """True if each row of a file counts."""
        rows = [self._known.get(key) for key in self._keys[part]]
        return all(row is not None and row.part == part for row in rows)

    def _current_rows(self, part: str) -> pa.Table:
        """Rows of a file that count, with all columns."""
        table = self._arrow(part)
        names = (table[name].to_pylist() for name in ('key', *PARTITIONS))
        kept = []
        for k, (key, *camera) in enumerate(zip(*names, strict=True)):
            row = self._known.get(key)
            if row is not None and (row.part, row.camera) == (part, tuple(camera)):
                kept.append(k)
        return table.take(pa.array(kept, pa.int64()))

    def _arrow(self, part: str) -> pa.Table:
        """A file with all columns of the schema, those of its folder and new ones added."""
        camera = self._camera_of(part)
        with _naming(part):
            table = _opened(part).read()
            columns = []
            for field in SCHEMA:
                if field.name in camera:
                    column = pa.array([camera[field.name]] * len(table), field.type)
                elif field.name in table.column_names:
                    column = table[field.name].cast(field.type)
                else:
                    column = pa.array([_DEFAULTS[field.name]] * len(table), field.type)
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
            self._keys[url] = table['key'].to_pylist()
            for key in self._keys[url]:
                self._known[key] = dataclasses.replace(self._known[key], part=url)

    def _folder(self, part: str) -> str:
        """Folder of a file below the table."""
        return posixpath.dirname(part.removeprefix(self.folder).lstrip('/'))

    def _camera_of(self, part: str) -> dict[str, str]:
        """Columns that the folder of a file has; empty for a new one."""
        pairs = [name.partition('=') for name in self._folder(part).split('/')]
        if tuple(name for name, _, _ in pairs) != PARTITIONS:
            return {}
        return {n: '' if v == NO_NAME else urllib.parse.unquote(v) for n, _, v in pairs}


@contextlib.contextmanager
def _naming(part: str) -> Iterator[None]:
    """Raise ProductError in one line; damaged Parquet raises errors of no common base class."""
    try:
        yield
    except Exception as error:
        words = ' '.join(str(error).split())[:120]
        raise ProductError(
            f'{part}: not a table of starcal trend: {words}; remove the file to make '
            'its rows again'
        ) from error


def _opened(part: str) -> pq.ParquetFile:
    file = pq.ParquetFile(pa.BufferReader(places.read(part, _MOST_BYTES)))
    groups = [file.metadata.row_group(k) for k in range(file.metadata.num_row_groups)]
    if sum(g.column(k).num_values for g in groups for k in range(g.num_columns)) > _MOST_VALUES:
        raise ValueError(f'more than {_MOST_VALUES} values')
    return file
