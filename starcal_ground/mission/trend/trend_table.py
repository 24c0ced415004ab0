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
import posixpath
import sqlite3
from typing import Annotated, Any, get_type_hints
import urllib.parse
import weakref

import numpy as np

from starcal_ros import untrusted
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import Derivatives
from starcal_ros.assessment.requirements import requirement_answers
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD, software_version
from starcal_ros.errors import ProductError
from starcal_ros.record_fields import check_shape, Finite, json_object, read_record, Stamp
from starcal_ros.records import Calibration, CameraGeometry, check_drawable
from starcal_ros.text import printable

RECORDED, COMPUTED, FAILED = 'recorded', 'computed', 'failed'
_LONGEST = 20_000  # characters of a text: a path has 4096, each of up to four after `printable`
_LONGEST_ERROR = 2000
_LONGEST_NAME, _LONGEST_STAMP = 100, 16  # characters of bag and stamp in the name of a folder
_MOST, _LEAST = 1e15, 1e-30  # squares of numbers and their inverses must stay finite


@dataclass(frozen=True)
class Row:
    """
    A calibration, or the reason why there is none.

    Raises ValueError in one line, for a row that the page could not show.

    ``stamp`` is the digest of name, size and time, or etag, of the file when it was read.
    ``kind`` is ``recorded`` (read from a file), ``computed`` (from a bag) or ``failed``.  Times
    are of the middle, first and last image; ``active_since_ns`` is 0 where it was not activated.
    ``requirements`` are a sentence on each requirement, with its answer.
    ``sigmas`` has those of ``values``, then of three alignment angles (rad);
    ``boresight_sigma_arcsec`` is about x and y of the camera, of the middle of the detector, in
    the star tracker frame.
    """

    stamp: str
    path: str
    kind: str
    error: str = ''
    software: str = ''
    time_ns: Stamp = 0
    first_ns: Stamp = 0
    last_ns: Stamp = 0
    number: int = 0
    active_since_ns: Stamp = 0
    accepted: bool = False
    forced: bool = False
    reasons: str = ''
    requirements: tuple[str, ...] = ()
    parent_frame: str = ''
    child_frame: str = ''
    lens_model: str = ''
    width: int = 0
    height: int = 0
    images: int = 0
    stars: int = 0
    residual_rms_px: float = math.nan
    temperature_degc: float = math.nan
    names: tuple[str, ...] = ()
    values: Annotated[tuple[float, ...], Finite()] = ()
    sigmas: tuple[float, ...] = ()
    star_tracker_from_camera_xyzw: Annotated[tuple[float, ...], Finite()] = ()
    boresight_sigma_arcsec: tuple[float, ...] = ()
    spacecraft: str = ''
    camera: str = ''

    def __post_init__(self) -> None:
        """Check what `series` and `trend_page` rely on."""
        for name, value in vars(self).items():
            if isinstance(value, str) and len(untrusted.check_text(value)) > _LONGEST:
                raise ValueError(f'{name}: {len(value)} characters')
        if self.error:
            return
        names = self.geometry.camera.parameter_names
        if self.names != names:
            raise ValueError(f'names: not {", ".join(names)}')
        lengths = {'sigmas': len(names) + 3, 'boresight_sigma_arcsec': 2}
        for name, length in {**lengths, 'star_tracker_from_camera_xyzw': 4}.items():
            check_shape((len(getattr(self, name)),), (length,), name, {})
        for number in (*self.sigmas, *self.boresight_sigma_arcsec, self.temperature_degc):
            if abs(number) > _MOST or 0.0 < abs(number) < _LEAST:
                raise ValueError(f'{number:.6g} is not a plausible sigma or temperature')
        check_drawable(self.geometry)

    @property
    def geometry(self) -> CameraGeometry:
        """Camera, without a field, and alignment."""
        camera = CameraModel(self.width, self.height, np.array(self.values), self.lens_model)
        return CameraGeometry(camera, np.array(self.star_tracker_from_camera_xyzw))


def row_of(
    calibration: Calibration, stamp: str, path: str, kind: str, temperature_degc: float
) -> Row:
    """Row of a calibration."""
    camera, terms = calibration.geometry.camera, calibration.temperature
    if math.isnan(temperature_degc) and terms is not None:
        temperature_degc = terms.reference_degc
    first_ns = calibration.first_image_ns or calibration.time_ns
    return Row(
        stamp=stamp,
        path=printable(path),
        kind=kind,
        software=calibration.provenance.get('software', ''),
        time_ns=(first_ns + calibration.time_ns) // 2,
        first_ns=first_ns,
        last_ns=calibration.time_ns,
        number=calibration.number,
        active_since_ns=calibration.active_since_ns,
        accepted=calibration.accepted,
        forced=calibration.forced,
        reasons='; '.join(calibration.reasons),
        requirements=requirement_answers(calibration),
        parent_frame=calibration.parent_frame,
        child_frame=calibration.child_frame,
        lens_model=camera.model,
        width=camera.width,
        height=camera.height,
        images=calibration.images_used,
        stars=calibration.stars_used,
        residual_rms_px=calibration.residual_rms_px,
        temperature_degc=temperature_degc,
        names=camera.parameter_names,
        values=tuple(camera.parameters.tolist()),
        sigmas=tuple(calibration.sigma.tolist()),
        star_tracker_from_camera_xyzw=tuple(
            calibration.geometry.star_tracker_from_camera_xyzw.tolist()
        ),
        boresight_sigma_arcsec=tuple(_boresight_sigma(calibration).tolist()),
    )


def kept_name(row: Row) -> str:
    """Path of the folder of a bag below the folder of kept calibrations."""
    bag = posixpath.basename(row.path).removesuffix('.mcap')
    spacecraft, camera, bag = (
        urllib.parse.quote(name, safe=' ') for name in (row.spacecraft, row.camera, bag)
    )
    series = f'spacecraft={spacecraft or "-"}/camera={camera or "-"}'
    return f'{series}/{bag[:_LONGEST_NAME]}-{row.stamp[:_LONGEST_STAMP]}'


def failure(stamp: str, url: str, error: str) -> Row:
    """Row of a calibration or bag that this version cannot use."""
    return Row(
        stamp=stamp,
        path=printable(url),
        kind=FAILED,
        error=printable(' '.join(error.split()) or 'failed')[:_LONGEST_ERROR],
        software=f'starcal {software_version()}',
    )


def _boresight_sigma(calibration: Calibration) -> Floats:
    """1-sigma (2,) of the line of sight of the middle, about the x and y axes, arcsec."""
    camera = calibration.geometry.camera
    middle = np.array([[(camera.width - 1) / 2, (camera.height - 1) / 2]])
    derivatives = Derivatives.at(camera, middle)
    (covariance,) = derivatives.covariance_rad2(calibration.map_covariance, derivatives.J)
    # A small rotation about x moves the direction along y, one about y along x.
    return np.asarray(np.sqrt(np.diag(covariance)[[1, 0]]) / ARCSECOND_RAD)


TABLE_FILE = 'trend.sqlite'
_WAIT_S = 60.0  # for the transaction of another run
_COLUMNS: dict[str, Any] = get_type_hints(Row)
_TYPES = {int: 'integer', bool: 'integer', float: 'real', str: 'text'}
_LISTS = [name for name, kind in _COLUMNS.items() if kind not in _TYPES]  # as JSON
_FLAGS = [name for name, kind in _COLUMNS.items() if kind is bool]
_NAMES = ', '.join(f'"{name}"' for name in _COLUMNS)
_SCHEMA = (
    'CREATE TABLE calibration ({}, PRIMARY KEY (stamp)) STRICT'.format(
        ', '.join(f'"{name}" {_TYPES.get(kind, "text")}' for name, kind in _COLUMNS.items())
    ),
    'CREATE INDEX of_camera ON calibration (spacecraft, camera, time_ns, stamp)',
)


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
        of_task = stamp, spacecraft, camera, RECORDED, f'starcal {software_version()}'
        with self._naming():
            found = self._db.execute(
                'SELECT 1 FROM calibration WHERE stamp = ? AND spacecraft = ? AND camera = ? '
                'AND (kind = ? OR software = ?)',
                of_task,
            )
            return found.fetchone() is not None

    def add(self, row: Row) -> None:
        """Add a row; it replaces that of its stamp, of another version or name of the camera."""
        values = json_object(row)
        values.update({name: json.dumps(values[name]) for name in _LISTS})
        places = ', '.join(f':{name}' for name in _COLUMNS)
        with self._naming():
            self._db.execute(
                f'INSERT OR REPLACE INTO calibration ({_NAMES}) VALUES ({places})', values
            )

    def forget_failures(self, but: Iterable[str]) -> None:
        """Remove the failures of all stamps but some."""
        with self._naming():
            self._db.execute(
                'DELETE FROM calibration WHERE kind = ? AND stamp NOT IN '
                '(SELECT value FROM json_each(?))',
                (FAILED, json.dumps([*but])),
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
                    'ORDER BY time_ns, stamp',
                    camera,
                ).fetchall()
                of_camera = [_row(dict(zip(_COLUMNS, row, strict=True))) for row in rows]
            yield of_camera

    def rows(self) -> list[Row]:
        """All rows, in order of time."""
        rows = (row for rows in self.cameras() for row in rows)
        return sorted(rows, key=lambda row: (row.time_ns, row.stamp))

    def _schema(self) -> set[str]:
        statements = self._db.execute('SELECT sql FROM sqlite_master WHERE sql IS NOT NULL')
        return {statement for (statement,) in statements}

    @contextlib.contextmanager
    def transaction(self) -> Iterator[None]:
        """Write what is added in the block at once, or nothing of it."""
        with self._naming(), self._db:
            self._db.execute('BEGIN IMMEDIATE')
            yield

    @contextlib.contextmanager
    def _naming(self) -> Iterator[None]:
        """Raise errors of the block as ProductError in one line that names the file."""
        try:
            yield
        # The disk, the rights or another run are the cause: the table itself is sound.
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
    values.update({name: untrusted.json_value(values[name]) for name in _LISTS})
    values.update({name: bool(values[name]) for name in _FLAGS})
    return read_record(Row, values)
