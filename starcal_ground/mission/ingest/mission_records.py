# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records that the readers of mission formats return, CSV tables of them, and strict reading.

CSV tables have a header of named columns, in any case, separated by commas, semicolons or tabs.  A
column of times is ``time_utc``, ``time_tai``, ``time_tt``, ``time_tdb`` or ``time_gps`` (dates) or
``time_ns`` (UTC stamps).  Attitudes are ``qx, qy, qz, qw``, the orientation of the star tracker in
the ICRF; velocities ``vx_m_s, vy_m_s, vz_m_s``, barycentric along ICRF axes; ``file`` names an
image.

Readers run in a child process with limits of memory and time.  A file of a few megabytes can
inflate to gigabytes, keep a library busy for minutes, name a pipe that nobody writes to, or crash
compiled code.  No reader can exclude all of that for its format: here it ends the child process,
and costs the file one line.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
import csv
from dataclasses import dataclass
import functools
import itertools
import math
import os
from pathlib import Path
import re
import resource
import signal
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcal_ground.child_process import ChildProcess, ProcessEnded
from starcal_ground.images.time_systems import from_text, SYSTEMS, to_utc_ns
from starcal_ros.arrays import Floats, Indices
from starcal_ros.errors import errors_as, IngestError, StarcalError
from starcal_ros.untrusted import read_text, regular_file

if TYPE_CHECKING:
    from typing_extensions import Self

Row = dict[str, str]
Result = TypeVar('Result')
# The frames whose axes are taken as those of the ICRF; the second set differs by the frame bias.
ICRF_NAMES = ('ICRF', 'ICRF1', 'ICRF2', 'ICRF3', 'GCRF', 'ICRS', 'GCRS')
EME2000_NAMES = ('EME2000', 'J2000')
_TEXT_BYTES = 1 << 29  # attitudes of a day at 10 Hz have 100 MB
_START_BYTES = 2048
EME2000_NOTE = 'EME2000 is taken as ICRF; its axes differ by 20 mas'  # IERS Conventions 2010, 5.4


@dataclass(frozen=True)
class Attitudes:
    """
    Attitudes of a star tracker in order of time.

    Attributes
    ----------
    time_ns : (n,) int64
        UTC stamps, ascending and different.
    icrf_from_star_tracker_xyzw : (n, 4)
    notes : tuple of str
        What a reader of the bag must know of them, one line each.
    """

    time_ns: NDArray[np.int64]
    icrf_from_star_tracker_xyzw: Floats
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Velocities:
    """Barycentric velocities (n, 3) in m/s along ICRF axes at UTC stamps (n,), and notes."""

    time_ns: NDArray[np.int64]
    velocity_m_s: Floats
    notes: tuple[str, ...] = ()


def text_of(path: Path) -> str:
    """Text of a file in UTF-8; raises IngestError when it cannot be read or is too large."""
    with errors_as(IngestError, path):
        return read_text(path, _TEXT_BYTES).removeprefix('\ufeff')  # byte-order mark


def start_of(path: Path) -> bytes:
    """First 2 kB of a regular file, by which its format is known; raises as `text_of`."""
    with errors_as(IngestError, path), regular_file(path) as file:
        return file.read(_START_BYTES)


def frame_notes(name: str) -> tuple[str, ...]:
    """Notes on an inertial frame; raises ValueError for a frame that is not ICRF or EME2000."""
    known = name.strip().upper()
    if known in ICRF_NAMES:
        return ()
    if known in EME2000_NAMES:
        return (EME2000_NOTE,)
    raise ValueError(f'frame {name!r} is neither ICRF nor EME2000: convert it first')


def is_inertial(name: str) -> bool:
    """True if a frame is one of ICRF or EME2000."""
    return name.strip().upper() in (*ICRF_NAMES, *EME2000_NAMES)


def in_order(time_ns: ArrayLike, xyzw: ArrayLike, notes: tuple[str, ...] = ()) -> Attitudes:
    """
    Attitudes sorted by time, each stamp once (of equal stamps the first), scaled to unit length.

    Raises ValueError when there are none, or a quaternion is not of unit length.
    """
    stamps, first = np.unique(np.asarray(time_ns, np.int64), return_index=True)
    if not len(stamps):
        raise ValueError('no attitudes')
    quaternions = np.asarray(xyzw, np.float64)[first]
    norm = np.linalg.norm(quaternions, axis=1)
    wrong = ~(np.abs(norm - 1.0) <= 1e-3)  # rounding in single precision is 1e-7
    if wrong.any():
        raise ValueError(
            f'attitude {int(wrong.argmax()) + 1} is not a unit quaternion '
            f'(length {norm[wrong][0]:.4f}); {int(wrong.sum())} of {len(norm)}'
        )
    return Attitudes(stamps, quaternions / norm[:, None], notes)


_QUATERNION = ('qx', 'qy', 'qz', 'qw')
_VELOCITY = ('vx_m_s', 'vy_m_s', 'vz_m_s')


def read_attitudes(path: Path) -> Attitudes:
    """Attitudes of a CSV file; raises IngestError naming the line that is wrong."""
    stamps, quaternions = _stamps_and_numbers(path, _QUATERNION)
    with errors_as(IngestError, path):
        return in_order(stamps, quaternions)


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
    lines = (match[0] for match in re.finditer(r'[^\r\n]+', text_of(path)))
    lines = (line for line in lines if not line.startswith('#'))
    header = next(lines, '')
    mark = max(',;\t', key=header.count)  # spreadsheets use another mark in another country
    table = csv.DictReader(itertools.chain([header], lines), delimiter=mark)
    number = 1
    try:
        names = [name.strip().lower() for name in table.fieldnames or ()]
        missing = [name for name in needed if name not in names]
        if missing or not any(_is_time(name) for name in names):
            wanted = ', '.join((*missing, 'time_utc'))
            raise IngestError(f'{path}: a table without the columns {wanted}')
        table.fieldnames = names
        for number, row in enumerate(table, start=2):  # noqa: B007
            yield _stamp(row), read(row)
    except csv.Error as error:
        raise IngestError(f'{path}: not a table of text: {error}') from error
    except ValueError as error:
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


_ADDRESS_SPACE = 9 << 27  # bytes; Python and the libraries take 0.5 GB, of which 0.1 are in memory


class Guard:
    """
    One child process that calls functions for its parent; it is started again after its end.

    Use it in a ``with`` statement.

    Parameters
    ----------
    processor_s : float
        Limit of a call; 10^6 attitudes in a table take 6 s on a processor of 3 GHz.
    wall_s : float
        Limit of a call that waits; longer, since other processes may share the processor.
    """

    def __init__(self, processor_s: float = 10.0, wall_s: float = 30.0) -> None:
        self._limits_s = (processor_s, wall_s)
        self._process: ChildProcess | None = None

    def __enter__(self) -> Self:
        """Return the guard; its process starts with the first call."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        if self._process is not None:
            self._process.end()
            self._process = None

    def call(self, where: object, function: Callable[..., Result], *args: object) -> Result:
        """
        Result of a function that reads the files named by ``where``.

        Raises IngestError with the text of a `StarcalError` of the function; naming the files, for
        another exception and for a call that exceeds a limit or crashes.
        """
        self._process = process = self._process or ChildProcess()
        limited = functools.partial(_limited, self._limits_s, function)
        try:
            return process.call(limited, *args)
        except ProcessEnded as error:
            self._process = None
            raise IngestError(f'{where}: {self._reason(error.args[0])}') from error
        except StarcalError as error:
            raise IngestError(str(error)) from error
        except MemoryError as error:
            raise IngestError(
                f'{where}: needs more than 1 GB of memory to be read: damaged, or too large'
            ) from error
        except Exception as error:
            words = ' '.join(f'{type(error).__name__} {error}'.split())
            raise IngestError(f'{where}: cannot be read: {words[:240]}') from error

    def _reason(self, status: int) -> str:
        """Reason for an exit status of the process."""
        if status == -signal.SIGPROF:
            return (
                f'takes more than {self._limits_s[0]:g} s of processor time to be read: damaged?'
            )
        if status == -signal.SIGALRM:
            return f'takes more than {self._limits_s[1]:g} s to be read: does it name a pipe?'
        return f'ends its reader with status {status}: damaged?'


def _limited(
    limits_s: tuple[float, float], function: Callable[..., Result], *args: object
) -> Result:
    """Result of a function in this process, which ends where it exceeds a limit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # warnings of libraries about the files
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    # Their signals end the process, wherever it is: Python code could not.
    timers = (signal.ITIMER_PROF, signal.ITIMER_REAL)
    for timer, limit_s in zip(timers, limits_s, strict=True):
        signal.setitimer(timer, limit_s)
    try:
        return function(*args)
    finally:
        for timer in timers:
            signal.setitimer(timer, 0.0)
