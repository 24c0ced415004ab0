# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records that the readers of mission formats return."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcal_ground.images.time_systems import TimeError
from starcal_ros.arrays import Floats
from starcal_ros.errors import errors_as, IngestError
from starcal_ros.untrusted import read_text, regular_file

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
    by_stars : bool
        The star tracker is the camera itself, and the attitudes are by its own stars.
    rows_upward : bool
        The attitudes are for FITS images with the order of their rows reversed.
    """

    time_ns: NDArray[np.int64]
    icrf_from_star_tracker_xyzw: Floats
    notes: tuple[str, ...] = ()
    by_stars: bool = False
    rows_upward: bool = False


@dataclass(frozen=True)
class Velocities:
    """Barycentric velocities (n, 3) in m/s along ICRF axes at UTC stamps (n,), and notes."""

    time_ns: NDArray[np.int64]
    velocity_m_s: Floats
    notes: tuple[str, ...] = ()


@contextlib.contextmanager
def naming(where: object) -> Iterator[None]:
    """Raise IngestError naming a file, for what its reader raises about its content."""
    try:
        with errors_as(IngestError, where):
            yield
    except TimeError as error:
        raise IngestError(f'{where}: {error}') from error


def text_of(path: Path) -> str:
    """Text of a file in UTF-8; raises IngestError when it cannot be read or is too large."""
    with naming(path):
        return read_text(path, _TEXT_BYTES).removeprefix('\ufeff')  # byte-order mark


def start_of(path: Path) -> bytes:
    """First 2 kB of a regular file, by which its format is known; raises as `text_of`."""
    with naming(path), regular_file(path) as file:
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
    wrong = ~(np.abs(norm - 1.0) <= 1e-3)  # single precision keeps 1e-7; this is no rounding
    if wrong.any():
        raise ValueError(
            f'attitude {int(wrong.argmax()) + 1} is not a unit quaternion '
            f'(length {norm[wrong][0]:.4f}); {int(wrong.sum())} of {len(norm)}'
        )
    return Attitudes(stamps, quaternions / norm[:, None], notes)
