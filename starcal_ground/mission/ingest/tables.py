# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
CSV tables of attitudes, velocities and times, with a header of named columns.

A column of times is ``time_utc``, ``time_tai``, ``time_tt``, ``time_tdb`` or ``time_gps`` (dates)
or ``time_ns`` (UTC stamps).  Attitudes are ``qx, qy, qz, qw``, the orientation of the star tracker
in the ICRF; velocities ``vx_m_s, vy_m_s, vz_m_s``, barycentric along ICRF axes; ``file`` names an
image.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import csv
import functools
import math
from pathlib import Path
import re
from typing import TypeVar

import numpy as np

from starcal_ground.images.time_systems import from_text, SYSTEMS, TimeError, to_utc_ns
from starcal_ground.mission.ingest import mission_records
from starcal_ground.mission.ingest.mission_records import Attitudes, naming, Velocities
from starcal_ros.arrays import Floats, Indices
from starcal_ros.errors import IngestError

Row = dict[str, str]
Result = TypeVar('Result')

_QUATERNION = ('qx', 'qy', 'qz', 'qw')
_VELOCITY = ('vx_m_s', 'vy_m_s', 'vz_m_s')


def read_attitudes(path: Path) -> Attitudes:
    """Attitudes of a CSV file; raises IngestError naming the line that is wrong."""
    stamps, quaternions = _stamps_and_numbers(path, _QUATERNION)
    with naming(path):
        return mission_records.in_order(stamps, quaternions)


def read_velocities(path: Path) -> Velocities:
    """Velocities of a CSV file, in order of time; raises as `read_attitudes`."""
    stamps, values = _stamps_and_numbers(path, _VELOCITY)
    order = np.argsort(stamps, kind='stable')
    return Velocities(stamps[order], values[order])


def read_times(path: Path) -> dict[str, int]:
    """Stamps by the names of images, without folders; raises as `read_attitudes`."""
    return {Path(row['file'] or '').name: stamp for stamp, row in _rows(path, ('file',), dict)}


def _stamps_and_numbers(path: Path, names: tuple[str, ...]) -> tuple[Indices, Floats]:
    """Stamps (n,) and the numbers (n, k) of some columns."""
    stamps, numbers = array('q'), array('d')
    for stamp, values in _rows(path, names, functools.partial(_numbers, names)):
        stamps.append(stamp)
        numbers.extend(values)
    return np.array(stamps, np.int64), np.array(numbers).reshape(-1, len(names))


def _rows(
    path: Path, needed: tuple[str, ...], read: Callable[[Row], Result]
) -> Iterator[tuple[int, Result]]:
    """Rows, one at a time: their stamps and what a function reads in them."""
    lines = (found[0] for found in re.finditer(r'[^\r\n]+', mission_records.text_of(path)))
    table = csv.DictReader(line for line in lines if not line.startswith('#'))
    number = 1
    try:
        names = [name.strip() for name in table.fieldnames or ()]
        missing = [name for name in needed if name not in names]
        if missing or not any(_is_time(name) for name in names):
            wanted = ', '.join((*missing, 'time_utc'))
            raise IngestError(f'{path}: a table without the columns {wanted}')
        table.fieldnames = names
        for number, row in enumerate(table, start=2):  # noqa: B007
            yield _stamp(row), read(row)
    except csv.Error as error:
        raise IngestError(f'{path}: not a table of text: {error}') from error
    except (TimeError, ValueError) as error:
        raise IngestError(f'{path} line {number}: {error}') from error


def _is_time(name: str) -> bool:
    kind, _, system = name.partition('_')
    return kind == 'time' and (system == 'ns' or system.upper() in SYSTEMS)


def _stamp(row: Row) -> int:
    name = next(name for name in row if name and _is_time(name))
    system = name.partition('_')[2]
    if system == 'ns':
        return to_utc_ns(int(row[name] or ''), 'UTC')
    return from_text(row[name] or '', system)


def _numbers(names: tuple[str, ...], row: Row) -> list[float]:
    try:
        values = [float(row[name]) for name in names]
    except (TypeError, ValueError) as error:
        raise ValueError(f'{", ".join(names)}: {error}') from error
    if not all(map(math.isfinite, values)):
        raise ValueError(f'{", ".join(names)} are not all finite')
    return values
