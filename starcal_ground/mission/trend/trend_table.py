# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The table of a trend: one SQLite file with a row for each calibration or failure.

Each row is a transaction of its own, so a kill loses the calibration that was running and no
other.  Only the client opens the file; workers send it their rows.  The journal is SQLite's
default and not the write-ahead log, whose index is memory shared by all processes that have the
file open: between machines on a network file system there is none.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
import contextlib
from dataclasses import dataclass
import json
import math
import os
from pathlib import Path
import sqlite3
from typing import Any
import weakref

from starcal_ros import untrusted
from starcal_ros.constants import software_version
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import calibration_from_content, calibration_text
from starcal_ros.record_fields import read_record, Stamp
from starcal_ros.records import Calibration

RECORDED, COMPUTED, FAILED = 'recorded', 'computed', 'failed'
TABLE_FILE = 'trend.sqlite'
_LONGEST = 20_000  # characters of a text: a path has 4096, each of up to four after `printable`
_WAIT_S = 60.0  # for the transaction of another run


@dataclass(frozen=True)
class Row:
    """
    A calibration, or the reason why there is none.

    Raises ValueError in one line, for a text that the page could not show.

    Attributes
    ----------
    stamp : str
        Digest of name, size and time, or etag, of the files when they were read.
    kind : str
        ``recorded`` (read from a file), ``computed`` (from a bag) or ``failed``.
    software : str
        Version that made the row.
    time_ns : int
        Middle of the first and the last image.
    temperature_degc : float
        Mean over the images; NaN if not known.
    calibration : Calibration or None
        None for a failure.
    """

    stamp: str
    path: str
    kind: str
    spacecraft: str = ''
    camera: str = ''
    software: str = f'starcal {software_version()}'
    error: str = ''
    time_ns: Stamp = 0
    temperature_degc: float = math.nan
    calibration: Calibration | None = None

    def __post_init__(self) -> None:
        """Check the texts."""
        for name, value in vars(self).items():
            if isinstance(value, str) and len(untrusted.check_text(value)) > _LONGEST:
                raise ValueError(f'{name}: {len(value)} characters')


_TYPES = {'time_ns': 'integer', 'temperature_degc': 'real'}
_COLUMNS = tuple(Row.__dataclass_fields__)
_SCHEMA = (
    'CREATE TABLE calibration ({}, PRIMARY KEY (stamp)) STRICT'.format(
        ', '.join(f'{name} {_TYPES.get(name, "text")}' for name in _COLUMNS)
    ),
    'CREATE INDEX of_camera ON calibration (spacecraft, camera, time_ns, stamp)',
)
_NAMES, _VALUES = ', '.join(_COLUMNS), ', '.join(f':{name}' for name in _COLUMNS)


class Table:
    """The table in a folder; raises ProductError where it cannot be read or written."""

    def __init__(self, folder: Path | str) -> None:
        self.path = Path(os.path.abspath(folder), TABLE_FILE)
        with self._naming():
            if os.path.lexists(self.path):
                with untrusted.regular_file(self.path):
                    pass
            # Python 3.13 warns of a connection that is left open. The collector closes it in
            # whichever thread it runs; SQLite itself takes turns.
            self._db = sqlite3.connect(
                self.path, timeout=_WAIT_S, isolation_level=None, check_same_thread=False
            )
            weakref.finalize(self, self._db.close)
            with self.transaction():
                if not self._schema():
                    for statement in _SCHEMA:
                        self._db.execute(statement)
                # Nor are views and triggers of others run.
                if self._schema() != {*_SCHEMA}:
                    raise ValueError('a database of another program or version')

    def has(self, stamp: str, spacecraft: str, camera: str) -> bool:
        """True for the row of a stamp and camera, recorded or made by this version."""
        return bool(
            self._rows(
                'SELECT 1 FROM calibration WHERE stamp = ? AND spacecraft = ? AND camera = ? '
                'AND (kind = ? OR software = ?)',
                (stamp, spacecraft, camera, RECORDED, Row.software),
            )
        )

    def add(self, row: Row) -> None:
        """Add a row; it replaces that of its stamp, of another version or name of the camera."""
        text = calibration_text(row.calibration) if row.calibration else None
        values = {**vars(row), 'calibration': text}
        self._rows(f'INSERT OR REPLACE INTO calibration ({_NAMES}) VALUES ({_VALUES})', values)

    def forget_failures(self, but: Iterable[str]) -> None:
        """Remove the failures of all stamps but some."""
        self._rows(
            'DELETE FROM calibration WHERE kind = ? AND stamp NOT IN '
            '(SELECT value FROM json_each(?))',
            (FAILED, json.dumps([*but])),
        )

    def names(self) -> list[tuple[str, str]]:
        """Spacecraft and camera of all rows, in order."""
        return self._rows('SELECT DISTINCT spacecraft, camera FROM calibration ORDER BY 1, 2')

    def cameras(self) -> Iterator[list[Row]]:
        """Rows of one camera after the other, each in order of time."""
        for camera in self.names():
            # Whole, so that no other run has to wait for a reader.
            rows = self._rows(
                f'SELECT {_NAMES} FROM calibration WHERE spacecraft = ? AND camera = ? '
                'ORDER BY time_ns, stamp',
                camera,
            )
            with self._naming():
                of_camera = [_row(dict(zip(_COLUMNS, row, strict=True))) for row in rows]
            yield of_camera

    def rows(self) -> list[Row]:
        """All rows, in order of time."""
        rows = (row for rows in self.cameras() for row in rows)
        return sorted(rows, key=lambda row: (row.time_ns, row.stamp))

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Write what is added in the block at once, or nothing of it."""
        with self._naming(), self._db:
            self._db.execute('BEGIN IMMEDIATE')
            yield

    def _schema(self) -> set[str]:
        return {sql for (sql,) in self._rows('SELECT sql FROM sqlite_master WHERE sql NOT NULL')}

    def _rows(self, statement: str, values: Any = ()) -> list[Any]:
        """Rows that a statement with values, in order or by name, gives."""
        with self._naming():
            return self._db.execute(statement, values).fetchall()

    @contextlib.contextmanager
    def _naming(self) -> Iterator[None]:
        """Raise errors of the block as ProductError in one line that names the file."""
        try:
            yield
        # The disk, the rights or another run are the cause: the table itself is sound.
        except (OSError, sqlite3.OperationalError) as error:
            words = getattr(error, 'strerror', '') or error
            raise ProductError(f'{self.path}: cannot be used: {words}') from error
        except (ValueError, ProductError, sqlite3.Error) as error:
            words = ' '.join(str(error).split())[:120]
            raise ProductError(
                f'{self.path}: not a sound table of starcal trend: {words}; move the file away '
                'to make its rows again'
            ) from error


def _row(values: dict[str, Any]) -> Row:
    """Row of the values of its columns; raises ValueError or ProductError in one line."""
    if values['calibration'] is not None:
        content = untrusted.json_value(values['calibration'])
        values['calibration'] = calibration_from_content(Path(values['path']), content)
    return read_record(Row, values)
