# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The Parquet table of a trend: a folder of files, each written whole, that grows without a rewrite.

``spacecraft=S/camera=C/*.parquet`` has the rows of a camera; ``_new`` those of a run that has not
ended, which are sorted in at its end or after 256 files; ``_seen`` the stamps of files whose row
is that of another file.  Readers of Parquet skip folders whose names start with an underscore.

A crash leaves complete files only.  Rows are unique by the start of their key; of several the
newest counts.  A file of a camera with 1000 rows is never rewritten for new ones.

The index of all rows is a temporary SQLite database, which goes to disk beyond its cache.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import itertools
import posixpath
import sqlite3
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
_FULL = 1000  # rows of a file of a camera that new ones are not merged with
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
# Their order is that of the columns of `row` below.
_STATE = ('key', *PARTITIONS, 'stamp', 'size_bytes', 'error', 'software', 'is_passing')
_INDEX = """
create table row (start primary key, spacecraft, camera, stamp, size, failed_with, is_passing,
                  part, is_counted);
create table stamp (stamp primary key, start);
create index of_size on row (size);
create index of_part on row (part);
pragma cache_size = -65536;
"""


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
        self._rows_in: dict[str, int] = {}  # by part
        self._index = sqlite3.connect('')  # a file without a name
        self._index.executescript(_INDEX)
        self._new_parts = 0
        try:
            places.make_folder(self.folder)
        except OSError as error:
            raise ProductError(f'{self.folder}: cannot be created: {error.strerror}') from error
        parts, seen = self._parts()
        for part in parts:
            self._note_part(part)
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
        start: str | None = self._one('select start from stamp where stamp = ?', task.stamp)
        return start

    def likely(self, task: Task) -> tuple[str, ...]:
        """Starts of the digests of rows whose content may be that of a task."""
        # The metadata of a bag may add a name that the task has not.
        found = self._index.execute(
            "select start from row where size = ? and ? in ('', spacecraft) and ? in ('', camera)"
            ' limit ?',
            (task.size, task.spacecraft, task.camera, _MOST_KNOWN + 1),
        ).fetchall()
        return tuple(start for (start,) in found) if len(found) <= _MOST_KNOWN else ()

    def count(self, start: str) -> bool:
        """True at the first call for a row."""
        return bool(
            self._index.execute(
                'update row set is_counted = 1 where start = ? and not is_counted', (start,)
            ).rowcount
        )

    def add(self, row: Row) -> bool:
        """Add a row, and return whether it is new: none with its key is of the same camera."""
        start = row.key[:START]
        if self._one(
            'select 1 from row where start = ? and spacecraft = ? and camera = ?',
            *(start, row.spacecraft, row.camera),
        ):
            self.add_seen(row.stamp, Seen(row.key))
            return False
        self._note([[getattr(row, name)] for name in _STATE], '')
        self.count(start)
        self._pending.append(row)
        if len(self._pending) >= _BATCH:
            self.flush()
        return True

    def add_seen(self, stamp: str, seen: Seen) -> None:
        """Note that a stamp is that of another row, or needs none."""
        if stamp:
            start = self._pending_seen[stamp] = seen.key[:START]
            self._index.execute('replace into stamp values (?, ?)', (stamp, start))

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

    def forget_failed(self, but: Iterable[str] = ()) -> None:
        """Remove failures, but lasting ones of some stamps that this version has tried."""
        failed = self._index.execute(
            "select start, stamp, failed_with, is_passing from row where failed_with != ''"
        ).fetchall()
        software = f'starcal {software_version()}'
        lasting = {stamp for _, stamp, by, passing in failed if by == software and not passing}
        kept = lasting.intersection(but) if lasting else lasting
        gone = [(start,) for start, stamp, *_ in failed if stamp not in kept]
        self._index.executemany('delete from row where start = ?', gone)
        if gone:
            self._index.execute(
                "delete from stamp where start != '' and start not in (select start from row)"
            )
            self._sort_in()

    def rows(self) -> list[Row]:
        """All rows on disk, in order of time."""
        return sorted(itertools.chain(*self.cameras()), key=lambda row: (row.time_ns, row.key))

    def cameras(self) -> Iterator[list[Row]]:
        """Rows on disk of one camera after the other, each in order of time."""
        parts = self._parts()[0]
        for part in parts:
            if part not in self._rows_in:
                self._note_part(part)
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
        return int(self._one('select count(*) from (select distinct spacecraft, camera from row)'))

    def _rows_of(self, part: str) -> list[Row]:
        """Rows of a file that count."""
        camera, rows = self._camera_of(part), []
        with _naming(part):
            for batch in _opened(part).iter_batches(_READ):
                rows += [read_record(Row, {**one, **camera}) for one in batch.to_pylist()]
        current = self._starts_in(part)
        return [row for row in rows if row.key[:START] in current]

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

    def _one(self, query: str, *values: object) -> Any:
        """The one value of a query; None without."""
        return (self._index.execute(query, values).fetchone() or (None,))[0]

    def _starts_in(self, part: str) -> set[str]:
        """Starts of the keys of the rows of a file that count."""
        found = self._index.execute('select start from row where part = ?', (part,))
        return {start for (start,) in found}

    def _note_part(self, part: str) -> None:
        """Note the rows of a file in the index."""
        camera = self._camera_of(part)
        with _naming(part):
            file = _opened(part)
            table = file.read([name for name in _STATE if name in file.schema_arrow.names])
            self._note([_column(table, name, camera).to_pylist() for name in _STATE], part)
            self._rows_in[part] = len(table)
        self._new_parts += self._folder(part) == _NEW

    def _note(self, columns: Sequence[Sequence[Any]], part: str) -> None:
        rows = [
            (key[:START], *names, stamp, size, (by or '-') if error else '', passing, part, False)
            for key, *names, stamp, size, error, by, passing in zip(*columns, strict=True)
        ]
        self._index.executemany('replace into row values (?, ?, ?, ?, ?, ?, ?, ?, ?)', rows)
        stamps = [(stamp, start) for start, _, _, stamp, *_ in rows if stamp]
        self._index.executemany('replace into stamp values (?, ?)', stamps)

    def _note_seen(self, parts: list[str]) -> None:
        for part in parts:
            with _naming(part):
                lines = _opened(part).read().select(['stamp', 'key']).to_pylist()
                self._index.executemany(
                    'insert or ignore into stamp select :stamp, :key'
                    " where :key = '' or exists (select 1 from row where start = :key)",
                    lines,
                )

    def _sort_in(self) -> None:
        """Write new rows into the files of their cameras; rows that are gone are left out."""
        parts, seen = self._parts()
        parts = [part for part in parts if part in self._rows_in]  # others are of another run
        new = [part for part in parts if self._folder(part) in ('', _NEW)]
        tables = [self._current_rows(part) for part in new]
        fresh = pa.concat_tables(tables) if tables else SCHEMA.empty_table()
        names = zip(*(fresh[name].to_pylist() for name in PARTITIONS), strict=True)
        of_camera: dict[str, list[int]] = {}
        for k, camera in enumerate(names):
            of_camera.setdefault(folder_of(*camera), []).append(k)
        counts = dict(self._index.execute('select part, count(*) from row group by part'))
        old: dict[str, list[str]] = {folder: [] for folder in of_camera}
        for part in (part for part in parts if part not in new):
            folder, count = self._folder(part), self._rows_in[part]
            if counts.get(part, 0) < count or (folder in of_camera and count < _FULL):
                old.setdefault(folder, []).append(part)
        for folder, own in old.items():  # one camera in memory at a time
            rows = [self._current_rows(part) for part in own]
            rows.append(fresh.take(pa.array(of_camera.get(folder, []), pa.int64())))
            self._write(folder, pa.concat_tables(rows))
            _remove(own)
        _remove(new)
        if len(seen) > 1:
            with _naming(seen[0]):
                merged = pa.concat_tables([_opened(part).read() for part in seen])
            self._write(_SEEN, merged)
            _remove(seen)
        self._new_parts = 0

    def _current_rows(self, part: str) -> pa.Table:
        """Rows of a file that count, with all columns."""
        table, current = self._arrow(part), self._starts_in(part)
        kept = [k for k, key in enumerate(table['key'].to_pylist()) if key[:START] in current]
        return table.take(pa.array(kept, pa.int64()))

    def _arrow(self, part: str) -> pa.Table:
        """A file with all columns of the schema, those of its folder and new ones added."""
        camera = self._camera_of(part)
        with _naming(part):
            table = _opened(part).read()
            columns = [_column(table, name, camera) for name in SCHEMA.names]
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
            starts = [(url, key[:START]) for key in table['key'].to_pylist()]
            self._index.executemany('update row set part = ? where start = ?', starts)
            self._rows_in[url] = len(table)

    def _folder(self, part: str) -> str:
        """Folder of a file below the table."""
        return posixpath.dirname(part.removeprefix(self.folder).lstrip('/'))

    def _camera_of(self, part: str) -> dict[str, str]:
        """Columns that the folder of a file has; empty for a new one."""
        pairs = [name.partition('=') for name in self._folder(part).split('/')]
        if tuple(name for name, _, _ in pairs) != PARTITIONS:
            return {}
        return {n: '' if v == NO_NAME else urllib.parse.unquote(v) for n, _, v in pairs}


def _column(table: pa.Table, name: str, camera: Mapping[str, str]) -> pa.ChunkedArray:
    """A column of a file, from its folder or with its default where the file has none."""
    kind = SCHEMA.field(name).type
    if name in table.column_names and name not in camera:
        return table[name].cast(kind)
    return pa.chunked_array([pa.array([{**_DEFAULTS, **camera}[name]] * len(table), kind)])


def _remove(parts: Iterable[str]) -> None:
    for part in parts:
        try:
            places.remove(part)
        except OSError as error:
            raise ProductError(f'{part}: cannot be removed: {error.strerror}') from error


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
