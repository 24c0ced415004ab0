# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
CCSDS attitude and orbit ephemerides (AEM, OEM), KVN or XML, read by ccsds-ndm.

Sources: CCSDS 504.0-B-2 (ADM) and 502.0-B-3 (ODM).  A quaternion A to B of an AEM gives, as frame
transformation, coordinates in B from those in A; as rotation operator, as in ROS and here, it
takes coordinates in B to those in A.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import re
from typing import Any

import erfa
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import AU_M, NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.ingest.records import (
    Attitudes,
    frame_notes,
    in_order,
    IngestError,
    is_inertial,
    start_of,
    text_of,
    Velocities,
)
from starcal_ros.ingest.time_systems import from_text, system_of, TimeError
from starcal_ros.sky.astrometry import tt_julian_date

_KM = 1000.0
_DAY_S = 86400.0
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_STATES = ('quaternion_state', 'quaternion_ephemeris', 'quaternion_derivative')
# ccsds-ndm 3.1.1 fails on KVN of AEM 2.0; its quaternions are those of AEM 1.0, A2B, scalar last.
_AEM_2 = re.compile(r'^(\s*CCSDS_AEM_VERS\s*=\s*)2\.0', re.MULTILINE)
_ATTITUDE_TYPE = re.compile(r'^(\s*ATTITUDE_TYPE\s*=\s*QUATERNION\S*)[ \t]*$', re.MULTILINE)


def is_ccsds(path: Path) -> bool:
    """Whether a file begins as a CCSDS message, KVN or XML."""
    start = start_of(path)
    return b'CCSDS_' in start or b'<aem' in start or b'<oem' in start


def read_aem(path: Path, star_tracker: str = '') -> Attitudes:
    """
    Attitudes of an AEM with quaternions; ``star_tracker`` is the body frame, if it has several.

    Raises
    ------
    IngestError
        When the file cannot be read, is no AEM, or names a time system or frames that cannot be
        converted.
    """
    where = str(path)
    segments = _segments(path, 'Aem')
    bodies = dict.fromkeys(_frames(segment.metadata, where)[1] for segment in segments)
    chosen = star_tracker.upper() or next(iter(bodies))
    if chosen not in bodies or (len(bodies) > 1 and not star_tracker):
        raise IngestError(
            f'{where}: body frames {", ".join(bodies)}: choose one with --star-tracker'
        )
    stamps: list[int] = []
    quaternions: list[Floats] = []
    notes: list[str] = []
    for segment in segments:
        inertial, body, is_operator = _frames(segment.metadata, where)
        if body != chosen:
            continue
        notes += frame_notes(inertial, where)
        system = _system(segment.metadata, where)
        for epoch, q in _quaternions(segment, where):
            stamps.append(_stamp(epoch, system, where))
            quaternions.append(q if is_operator else q * _CONJUGATE)
        if system != 'UTC':
            notes.append(f'times converted from {system} to UTC')
    return in_order(stamps, quaternions, where, tuple(dict.fromkeys(notes)))


def read_oem(path: Path, at_ns: Sequence[int]) -> Velocities:
    """
    Barycentric velocities at stamps (n,), interpolated in the segments of an OEM.

    The velocity of the Earth or of the Sun is added where the ephemeris is about one of them.

    Raises
    ------
    IngestError
        When the file cannot be read, does not cover a stamp, or names a centre, a time system or
        a frame that cannot be converted.
    """
    where = str(path)
    at = np.array(at_ns, np.int64)
    found = np.full((len(at), 3), np.nan)
    notes: list[str] = []
    for segment in _segments(path, 'Oem'):
        notes += frame_notes(str(segment.metadata.ref_frame), where)
        system = _system(segment.metadata, where)
        states = segment.data.state_vector
        stamps = np.array([_stamp(state.epoch, system, where) for state in states], np.int64)
        position = np.array([[state.x.value, state.y.value, state.z.value] for state in states])
        velocity = np.array([[s.x_dot.value, s.y_dot.value, s.z_dot.value] for s in states])
        if len(stamps) < 2 or not (np.diff(stamps) > 0).all():
            raise IngestError(f'{where}: a segment has fewer than two states, or is out of order')
        inside = (at >= stamps[0]) & (at <= stamps[-1])
        # Seconds since the first state: those since 1970 have a resolution of 0.1 us.
        seconds = (stamps - stamps[0]) / NANOSECONDS_PER_SECOND
        orbit = CubicHermiteSpline(seconds, position, velocity)
        since_s = (at[inside] - stamps[0]) / NANOSECONDS_PER_SECOND
        center = str(segment.metadata.center_name)
        found[inside] = orbit(since_s, 1) * _KM + _center_velocity(center, at[inside], where)
    missing = ~np.isfinite(found[:, 0])
    if missing.any():
        raise IngestError(
            f'{where}: no velocity for {int(missing.sum())} of {len(at)} images, '
            f'the first at {utc_text(int(at[missing][0]))}'
        )
    return Velocities(at, found, tuple(dict.fromkeys(notes)))


def _segments(path: Path, kind: str) -> list[Any]:
    try:
        from ccsds_ndm.ndm_io import NdmIo
    except ModuleNotFoundError as error:
        raise IngestError(
            f"{path}: CCSDS files need ccsds-ndm: pip install 'starcal_ros[mission]'"
        ) from error
    text = text_of(path)
    # A few lines of nested entities expand to gigabytes, and an entity can name another file.
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise IngestError(f'{path}: a document type definition is not read; remove it')
    if _AEM_2.search(text):
        text = _ATTITUDE_TYPE.sub(r'\1\nATTITUDE_DIR = A2B\nQUATERNION_TYPE = LAST', text)
        text = _AEM_2.sub(r'\g<1>1.0', text)
    try:
        message = NdmIo().from_string(text)
    # The exceptions of its parsers depend on the field and have no common base class.
    except Exception as error:
        words = ' '.join(str(error).split())[:160]
        raise IngestError(f'{path}: not readable as CCSDS {kind.upper()}: {words}') from error
    if type(message).__name__ != kind:
        raise IngestError(f'{path}: is {type(message).__name__.upper()}, not {kind.upper()}')
    segments: list[Any] = message.body.segment
    return segments


def _frames(metadata: Any, where: str) -> tuple[str, str, bool]:
    """
    Inertial frame, body frame, and whether the quaternion is the rotation operator here.

    That is: it takes body coordinates to inertial ones.
    """
    a, b = str(metadata.ref_frame_a).upper(), str(metadata.ref_frame_b).upper()
    if is_inertial(a) == is_inertial(b):
        raise IngestError(
            f'{where}: frames {a} and {b}: one must be ICRF or EME2000, the other the star tracker'
        )
    direction = getattr(metadata, 'attitude_dir', None)
    forward = 'A2B' if direction is None else str(direction.value).upper()
    from_inertial = is_inertial(a) == (forward == 'A2B')
    return (a, b, from_inertial) if is_inertial(a) else (b, a, from_inertial)


def _system(metadata: Any, where: str) -> str:
    name = metadata.time_system
    try:
        return system_of(str(getattr(name, 'value', name)))
    except TimeError as error:
        raise IngestError(f'{where}: {error}') from error


def _quaternions(segment: Any, where: str) -> list[tuple[str, Floats]]:
    found = []
    for state in segment.data.attitude_state:
        value = next(
            (v for v in (getattr(state, n, None) for n in _STATES) if v is not None), None
        )
        if value is None:
            kind = getattr(segment.metadata.attitude_type, 'value', segment.metadata.attitude_type)
            raise IngestError(f'{where}: attitudes of type {kind}, not QUATERNION: convert them')
        q = value.quaternion
        found.append((str(value.epoch), np.array([q.q1, q.q2, q.q3, q.qc], np.float64)))
    return found


def _stamp(epoch: str, system: str, where: str) -> int:
    try:
        return from_text(str(epoch), system)
    except TimeError as error:
        raise IngestError(f'{where}: {error}') from error


def _center_velocity(center: str, at_ns: Indices, where: str) -> Floats:
    """Barycentric velocities (n, 3) of the centre of an ephemeris, m/s, ICRF axes."""
    name = center.strip().upper()
    if name in ('SOLAR SYSTEM BARYCENTER', 'SSB', 'SOLAR_SYSTEM_BARYCENTER'):
        return np.zeros((len(at_ns), 3))
    if name not in ('EARTH', 'SUN'):
        raise IngestError(
            f'{where}: centre {center!r} is not EARTH, SUN or SOLAR SYSTEM BARYCENTER; give the '
            'velocity as SPK kernels with a planetary ephemeris'
        )
    velocity = []
    for time_ns in at_ns:
        heliocentric, barycentric = erfa.epv00(*tt_julian_date(int(time_ns)))
        of_center = barycentric['v'] - (heliocentric['v'] if name == 'SUN' else 0.0)
        velocity.append(of_center * (AU_M / _DAY_S))
    return np.array(velocity).reshape(-1, 3)
