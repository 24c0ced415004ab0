# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The table of a trend: one SQLite file with a row for each calibration or failure.

Each row is a transaction of its own, so a kill loses the calibration that was running and no
other.  Only the client opens the file; workers send it their rows.  The journal is SQLite's
default and not the write-ahead log, whose index is memory shared by all processes that have the
file open: between machines on a network file system there is none.

The table ``seen`` has the stamps of files whose row is that of another file with the same
content, or that need no row.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
import json
import os
from pathlib import Path
import sqlite3
from typing import Any, get_type_hints

from starcal_ground.mission.trend.rows import Row
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.files import replacing
from starcal_ros.pipeline.solve import software_version
from starcal_ros.record_fields import json_object, read_record
from starcal_ros.untrusted import json_value, regular_file

TABLE_FILE, PARQUET_FILE = 'trend.sqlite', 'trend.parquet'
_WAIT_S = 60.0  # for the transaction of another run
_MOST_LIKELY = 1000  # keys sent with a task: with more of one size, the content is used again
_COLUMNS: dict[str, Any] = get_type_hints(Row)
_TYPES = {int: 'integer', bool: 'integer', float: 'real', str: 'text'}
_LISTS = [name for name, kind in _COLUMNS.items() if kind not in _TYPES]  # as JSON
_FLAGS = [name for name, kind in _COLUMNS.items() if kind is bool]
_NAMES = ', '.join(f'"{name}"' for name in _COLUMNS)
_SCHEMA = (
    'CREATE TABLE calibration ({}, PRIMARY KEY (key)) STRICT'.format(
        ', '.join(f'"{name}" {_TYPES.get(kind, "text")}' for name, kind in _COLUMNS.items())
    ),
    'CREATE TABLE seen (stamp text PRIMARY KEY, key text NOT NULL) STRICT',
    'CREATE INDEX of_camera ON calibration (spacecraft, camera, time_ns, key)',
    'CREATE INDEX of_size ON calibration (size_bytes)',
    "CREATE UNIQUE INDEX of_stamp ON calibration (stamp) WHERE stamp != ''",
)


class Table:
    """The table in a folder; raises ProductError where it cannot be read or written."""

    def __init__(self, folder: Path | str) -> None:
        self.path = Path(os.path.abspath(folder), TABLE_FILE)
        with self._naming():
            if os.path.lexists(self.path):
                with regular_file(self.path):
                    pass
            self._db = sqlite3.connect(self.path, timeout=_WAIT_S, isolation_level=None)
            with self.transaction():
                if not self._schema():
                    for statement in _SCHEMA:
                        self._db.execute(statement)
                # Nor are views and triggers of others run.
                if self._schema() != {*_SCHEMA}:
                    raise ValueError('a database of another program or version')

    def key_of(self, stamp: str) -> str | None:
        """Key of the row of a stamp; empty where none is due, None if not known."""
        with self._naming():
            keys = self._db.execute(
                "SELECT key FROM calibration WHERE stamp = ?1 AND stamp != '' UNION ALL "
                'SELECT key FROM seen WHERE stamp = ?1 AND '
                "(key = '' OR EXISTS (SELECT 1 FROM calibration AS c WHERE c.key = seen.key))",
                (stamp,),
            ).fetchone()
        return keys and str(keys[0])

    def likely(self, size_bytes: int, spacecraft: str, camera: str) -> tuple[str, ...]:
        """Keys of rows whose content may be that of a file; an empty name may be any."""
        with self._naming():
            keys = self._db.execute(
                "SELECT key FROM calibration WHERE size_bytes = ? AND error = '' "
                "AND ? IN ('', spacecraft) AND ? IN ('', camera) LIMIT ?",
                (size_bytes, spacecraft, camera, _MOST_LIKELY + 1),
            ).fetchall()
        return tuple(key for (key,) in keys) if len(keys) <= _MOST_LIKELY else ()

    def has(self, row: Row) -> bool:
        """True if a row of the same content and camera is there that is no failure."""
        with self._naming():
            return bool(
                self._db.execute(
                    'SELECT 1 FROM calibration WHERE key = ? AND spacecraft = ? AND camera = ? '
                    "AND error = ''",
                    (row.key, row.spacecraft, row.camera),
                ).fetchone()
            )

    def add(self, row: Row) -> None:
        """
        Add a row.

        It replaces a row of another camera with its key, since names of cameras change, and the
        failure with its stamp.
        """
        values = json_object(row)
        values.update({name: json.dumps(values[name]) for name in _LISTS})
        places = ', '.join(f':{name}' for name in _COLUMNS)
        with self._naming():
            self._db.execute(
                f'INSERT OR REPLACE INTO calibration ({_NAMES}) VALUES ({places})', values
            )

    def add_seen(self, stamp: str, key: str) -> None:
        """Note that a stamp is that of a row of another file, or needs none."""
        if stamp:
            with self._naming():
                self._db.execute('INSERT OR REPLACE INTO seen VALUES (?, ?)', (stamp, key))

    def failures(self) -> dict[str, bool]:
        """Stamps of failures; True for those to try again: passing, or of another version."""
        with self._naming():
            return {
                stamp: is_passing or software != f'starcal {software_version()}'
                for stamp, is_passing, software in self._db.execute(
                    "SELECT stamp, is_passing, software FROM calibration WHERE error != ''"
                )
            }

    def forget_failures(self, stamps: Iterable[str]) -> None:
        """Remove the failures of some stamps."""
        with self.transaction():
            self._db.executemany(
                "DELETE FROM calibration WHERE error != '' AND stamp = ?", zip(stamps, strict=True)
            )

    def names(self) -> list[tuple[str, str]]:
        """Spacecraft and camera of all rows, in order."""
        with self._naming():
            return self._db.execute(
                'SELECT DISTINCT spacecraft, camera FROM calibration ORDER BY 1, 2'
            ).fetchall()

    def cameras(self) -> Iterator[list[Row]]:
        """Rows of one camera after the other, each in order of time."""
        for camera in self.names():
            # Whole, so that no other run has to wait for a reader.
            with self._naming():
                rows = self._db.execute(
                    f'SELECT {_NAMES} FROM calibration WHERE spacecraft = ? AND camera = ? '
                    'ORDER BY time_ns, key',
                    camera,
                ).fetchall()
                found = [_row(dict(zip(_COLUMNS, row, strict=True))) for row in rows]
            yield found

    def rows(self) -> list[Row]:
        """All rows, in order of time."""
        rows = (row for rows in self.cameras() for row in rows)
        return sorted(rows, key=lambda row: (row.time_ns, row.key))

    def write_parquet(self) -> Path:
        """Write the rows as a Parquet file beside the table, a row group for each camera."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {str: pa.string(), int: pa.int64(), bool: pa.bool_(), float: pa.float64()}
        types[tuple[str, ...]] = pa.list_(pa.string())
        types[tuple[float, ...]] = pa.list_(pa.float64())
        schema = pa.schema([(name, types[kind]) for name, kind in _COLUMNS.items()])
        path = self.path.with_name(PARQUET_FILE)
        with (
            errors_as(ProductError, path, 'written'),
            replacing(path) as file,
            pq.ParquetWriter(file, schema) as writer,
        ):
            for rows in self.cameras():
                writer.write_table(pa.Table.from_pylist(list(map(json_object, rows)), schema))
        return path

    def _schema(self) -> set[str]:
        statements = self._db.execute('SELECT sql FROM sqlite_master WHERE sql IS NOT NULL')
        return {statement for (statement,) in statements}

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Write what is added in the block at once, or nothing of it."""
        if self._db.in_transaction:
            yield
            return
        with self._naming():
            self._db.execute('BEGIN IMMEDIATE')
            try:
                yield
                self._db.execute('COMMIT')
            finally:
                if self._db.in_transaction:
                    self._db.execute('ROLLBACK')

    @contextlib.contextmanager
    def _naming(self) -> Iterator[None]:
        """Raise errors of the block as ProductError in one line that names the file."""
        try:
            yield
        # Of the disk, of rights, or of another run: the table itself is sound.
        except (OSError, sqlite3.OperationalError) as error:
            words = getattr(error, 'strerror', '') or error
            raise ProductError(f'{self.path}: cannot be used: {words}') from error
        except (ValueError, sqlite3.Error) as error:
            words = ' '.join(str(error).split())[:120]
            raise ProductError(
                f'{self.path}: not a sound table of starcal trend: {words}; move the file away '
                'to make its rows again'
            ) from error


def _row(values: dict[str, Any]) -> Row:
    """Row of the values of its columns; raises ValueError in one line."""
    values.update({name: json_value(values[name]) for name in _LISTS})
    values.update({name: bool(values[name]) for name in _FLAGS})
    return read_record(Row, values)
