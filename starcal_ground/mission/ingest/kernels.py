# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Attitudes from SPICE CK and velocities from SPK, at the times of the images, by spiceypy.

SPICE's frame J2000 is the ICRF.  Times go through the leap seconds kernel that is given, so that
they are those of the tools that made the other kernels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import contextlib
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.mission.ingest import mission_records
from starcal_ground.mission.ingest.mission_records import Attitudes, Velocities
from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import errors_as, IngestError, needing
from starcal_ros.untrusted import read_bytes

_TEXT = b'KPL/'
_MAGIC = (_TEXT, b'DAF/', b'NAIF/DAF', b'DAS/', b'NAIF/DAS')
# A CK is sampled beside each image too: a stamp offset of the camera may be applied later.
_BESIDE_NS = (-NANOSECONDS_PER_SECOND, 0, NANOSECONDS_PER_SECOND)
_KM = 1000.0
_TEXT_BYTES = 1 << 26  # longest text kernel that is read: the largest in use have 1 MB


def is_kernel(path: Path) -> bool:
    """True if a file begins as a SPICE kernel."""
    return mission_records.start_of(path).startswith(_MAGIC)


def read_ck(paths: Sequence[Path], frame: str, at_ns: Sequence[int]) -> Attitudes:
    """
    Attitudes of a frame at stamps and one second about them, where the kernels cover these.

    Raises IngestError when a kernel cannot be read, the frame is not known, or no stamp is
    covered.

    Parameters
    ----------
    paths : sequence of Path
        CK, SCLK, LSK and, for a frame with a name, the FK that defines it.
    frame : str
        Name of the star tracker frame, or its CK identifier.
    """
    stamps: list[int] = []
    quaternions: list[Floats] = []
    with errors_as(IngestError, _names(paths)), loaded(paths) as spice:
        if not frame:
            raise ValueError('name the star tracker frame of the CK with --star-tracker')
        for time_ns in sorted({t + beside for t in at_ns for beside in _BESIDE_NS}):
            matrix = _icrf_from_frame(spice, frame, time_ns)
            if matrix is not None:
                stamps.append(time_ns)
                quaternions.append(Rotation.from_matrix(matrix).as_quat())
        if not stamps:
            raise ValueError(
                f'no attitude of {frame} from {utc_text(min(at_ns))} to '
                f'{utc_text(max(at_ns))}: the CK does not cover the images'
            )
        return mission_records.in_order(stamps, quaternions)


def read_spk(paths: Sequence[Path], body: str, at_ns: Sequence[int]) -> Velocities:
    """
    Barycentric velocities of a body at stamps.

    Raises IngestError when a kernel cannot be read, the body is not known or a stamp is not
    covered.
    """
    velocities = []
    with errors_as(IngestError, _names(paths)), loaded(paths) as spice:
        if not body:
            raise ValueError('name the spacecraft of the SPK with --spacecraft')
        for time_ns in at_ns:
            try:
                et = ephemeris_time(spice, time_ns)
                state, _ = spice.spkezr(body, et, 'J2000', 'NONE', 'SOLAR SYSTEM BARYCENTER')
            except spice.SpiceyError as error:
                raise ValueError(
                    f'no velocity of {body} about the solar system barycentre at '
                    f'{utc_text(time_ns)}: {short(error)}'
                ) from error
            velocities.append(np.array(state[3:]) * _KM)
    return Velocities(np.array(at_ns, np.int64), np.array(velocities).reshape(-1, 3))


def _names(paths: Sequence[Path]) -> str:
    return ', '.join(map(str, paths))


@contextlib.contextmanager
def loaded(paths: Sequence[Path]) -> Iterator[Any]:
    """SPICE with only these kernels loaded; earlier ones are loaded again afterwards."""
    with needing('mission', IngestError, _names(paths)):
        import spiceypy
    before = [spiceypy.kdata(k, 'ALL')[0] for k in range(spiceypy.ktotal('ALL'))]
    spiceypy.kclear()
    try:
        for path in paths:
            try:
                # SPICE waits for the writer of a pipe, and reads a text without end.
                for named in _named(spiceypy, path):
                    _text_of(named)
                spiceypy.furnsh(str(path))
            except spiceypy.SpiceyError as error:
                raise IngestError(f'{path}: not loaded by SPICE: {short(error)}') from error
        if not spiceypy.expool('DELTET/DELTA_AT'):
            raise IngestError(
                f'{_names(paths)}: no leap seconds kernel (LSK) among them: add naif*.tls'
            )
        yield spiceypy
    finally:
        spiceypy.kclear()
        for name in before:
            spiceypy.furnsh(name)


def _named(spice: Any, path: Path) -> list[Path]:
    """Files that a kernel names: those of a meta-kernel, none of another one."""
    if b'KERNELS_TO_LOAD' not in _text_of(path):
        return []
    spice.ldpool(str(path))
    names, symbols, values = (
        _texts(spice, name) for name in ('KERNELS_TO_LOAD', 'PATH_SYMBOLS', 'PATH_VALUES')
    )
    spice.dvpool('KERNELS_TO_LOAD')
    for symbol, value in zip(symbols, values, strict=False):
        names = [name.replace(f'${symbol}', value) for name in names]
    return [Path(name) for name in names]


def _text_of(path: Path) -> bytes:
    """Content of a text kernel, nothing of a binary one; IngestError for another file."""
    start = mission_records.start_of(path)
    if not start.startswith(_MAGIC):
        raise IngestError(f'{path}: not a SPICE kernel: it begins with none of KPL/, DAF/, DAS/')
    with errors_as(IngestError, path):
        return read_bytes(path, _TEXT_BYTES) if start.startswith(_TEXT) else b''


def _texts(spice: Any, name: str) -> list[str]:
    """Texts of a variable of SPICE; one that ends in + continues in the next."""
    texts: list[str] = []
    with contextlib.suppress(spice.NotFoundError):
        while True:
            texts.append(spice.stpool(name, len(texts), '+', 1024)[0])
    return texts


def _icrf_from_frame(spice: Any, frame: str, time_ns: int) -> Floats | None:
    """Rotation (3, 3) from a frame to the ICRF; None where the CK has none."""
    et = ephemeris_time(spice, time_ns)
    try:
        if frame.lstrip('-').isdigit():
            number = int(frame)
            # NAIF: the clock of a spacecraft has its number, -(structure // 1000).
            clock = -(abs(number) // 1000)
            matrix, _ = spice.ckgp(number, spice.sce2c(clock, et), 0.0, 'J2000')
            return np.array(matrix).T
        return np.array(spice.pxform(frame, 'J2000', et))
    except spice.NotFoundError:
        return None
    except spice.SpiceyError as error:
        # Both mark a CK without data at the time.
        if error.short in ('SPICE(NOFRAMECONNECT)', 'SPICE(FRAMEDATANOTFOUND)'):
            return None
        raise ValueError(f'frame {frame}: {short(error)}') from error


def ephemeris_time(spice: Any, time_ns: int) -> float:
    """TDB seconds past J2000 of a stamp, by the leap seconds kernel."""
    seconds, rest_ns = divmod(time_ns, NANOSECONDS_PER_SECOND)
    text = datetime.fromtimestamp(seconds, timezone.utc).strftime('%Y-%m-%dT%H:%M:%S')
    return float(spice.utc2et(text)) + rest_ns / NANOSECONDS_PER_SECOND


def short(error: Any) -> str:
    """The kind of a SPICE error and its explanation, in one line."""
    words = ' '.join(f'{error.short} {error.long}'.split())
    return words if len(words) <= 240 else words[:237] + '...'
