# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
CCSDS attitude and orbit ephemerides (AEM, OEM) in KVN.

Sources: CCSDS 504.0-B-1 and B-2 (AEM 1.0 and 2.0), 502.0-B-1 to B-3 (OEM 1.0 to 3.0).
A quaternion A to B of an AEM is a frame transformation: it converts coordinates in A to
coordinates in B.  Read as a rotation operator, as in ROS and in starcal, the same numbers convert
coordinates in B to coordinates in A.  AEM 1.0 has keywords for direction and order of its
quaternions; in AEM 2.0 they are A to B, scalar last.  A keyword that the version does not define
is refused: it may change the meaning of the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
import re

import erfa
import numpy as np
from numpy.typing import NDArray

from starcal_ground.images.time_systems import from_text, system_of
from starcal_ground.mission.ingest import mission_records
from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import AU_M, NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import errors_as, IngestError
from starcal_ros.sky.astrometry import tt_julian_date

_KM = 1000.0
_DAY_S = 86400.0
_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])
_KVN = re.compile(rb'^\s*CCSDS_\w+_VERS\s*=', re.MULTILINE)
# ATTITUDE_TYPE -> numbers of a line, of which four are the quaternion.
_BOTH = {'QUATERNION': 4, 'QUATERNION/DERIVATIVE': 8}
_TYPES = {'1.0': {**_BOTH, 'QUATERNION/RATE': 7}, '2.0': {**_BOTH, 'QUATERNION/ANGVEL': 7}}
_STATE_NUMBERS = (6, 9)  # position and velocity, without and with acceleration


def is_ccsds(path: Path) -> bool:
    """True if a file begins as a CCSDS message in KVN, or as XML, to be refused as such."""
    start = mission_records.start_of(path).removeprefix(b'\xef\xbb\xbf')
    return start.lstrip().startswith(b'<') or _KVN.search(start) is not None


def read_aem(path: Path, star_tracker: str = '') -> mission_records.Attitudes:
    """
    Attitudes of an AEM of quaternions; ``star_tracker`` selects one of several body frames.

    Raises IngestError when the file cannot be read, is not an AEM, or has a time system or frames
    that cannot be converted.
    """
    segments = read_segments(path, 'AEM')
    with errors_as(IngestError, path):
        bodies = dict.fromkeys(_frames(segment)[1] for segment in segments)
        chosen = star_tracker.upper() or next(iter(bodies))
        if chosen not in bodies or (len(bodies) > 1 and not star_tracker):
            raise ValueError(f'body frames {", ".join(bodies)}: choose one with --star-tracker')
        stamps: list[Indices] = []
        quaternions: list[Floats] = []
        notes: list[str] = []
        for segment in segments:
            inertial, body, is_forward = _frames(segment)
            if body != chosen:
                continue
            notes += mission_records.frame_notes(inertial)
            system = _system(segment)
            q, is_a_to_b = _quaternions(segment)
            at = _stamps(segment, system)
            keep = _useable(segment, at, system)
            stamps.append(at[keep])
            quaternions.append(q[keep] if is_forward == is_a_to_b else q[keep] * _CONJUGATE)
            if system != 'UTC':
                notes.append(f'times converted from {system} to UTC')
        return mission_records.in_order(
            np.concatenate(stamps), np.concatenate(quaternions), tuple(dict.fromkeys(notes))
        )


def read_oem(path: Path, at_ns: Sequence[int]) -> mission_records.Velocities:
    """
    Barycentric velocities at stamps (n,), interpolated in the segments of an OEM.

    The velocity of the Earth or of the Sun is added if it is the centre of the ephemeris.
    Raises IngestError when the file cannot be read, does not cover a stamp, or names a centre, a
    time system or a frame that cannot be converted.
    """
    from scipy.interpolate import CubicHermiteSpline  # a fifth of the start of a short command

    segments = read_segments(path, 'OEM')
    with errors_as(IngestError, path):
        at = np.array(at_ns, np.int64)
        velocities = np.full((len(at), 3), np.nan)
        notes: list[str] = []
        for segment in segments:
            notes += mission_records.frame_notes(_keyword(segment, 'REF_FRAME'))
            system = _system(segment)
            stamps = _stamps(segment, system)
            states = _numbers(segment, _STATE_NUMBERS)
            if len(stamps) < 2 or not (np.diff(stamps) > 0).all():
                raise ValueError('a segment has fewer than two states, or is out of order')
            inside = (at >= stamps[0]) & (at <= stamps[-1]) & _useable(segment, at, system)
            # Seconds since the first state: those since 1970 have a resolution of 0.1 us.
            seconds = (stamps - stamps[0]) / NANOSECONDS_PER_SECOND
            orbit = CubicHermiteSpline(seconds, states[:, :3], states[:, 3:6])
            since_s = (at[inside] - stamps[0]) / NANOSECONDS_PER_SECOND
            center = _keyword(segment, 'CENTER_NAME')
            velocities[inside] = orbit(since_s, 1) * _KM + _center_velocity(center, at[inside])
        missing = ~np.isfinite(velocities[:, 0])
        if missing.any():
            raise ValueError(
                f'no velocity for {int(missing.sum())} of {len(at)} images, '
                f'the first at {utc_text(int(at[missing][0]))}'
            )
        return mission_records.Velocities(at, velocities, tuple(dict.fromkeys(notes)))


def _keyword(segment: Segment, key: str, *values: str) -> str:
    """Value of a required keyword; it must be one of ``values`` unless that is empty."""
    value = segment.metadata.get(key, '').upper()
    if not value or (values and value not in values):
        expected = f' {" or ".join(values)}' if values else ''
        raise ValueError(
            f'keyword {key} is {value or "missing"}, but version {segment.version} requires'
            f' it{expected}: ask the producer of the file'
        )
    return value


def _frames(segment: Segment) -> tuple[str, str, bool]:
    """Inertial frame, body frame, and True if frame A is the inertial one."""
    a, b = (_keyword(segment, f'REF_FRAME_{name}') for name in 'AB')
    if mission_records.is_inertial(a) == mission_records.is_inertial(b):
        raise ValueError(
            f'frames {a} and {b}: one must be ICRF or EME2000, the other the star tracker'
        )
    return (a, b, True) if mission_records.is_inertial(a) else (b, a, False)


def _quaternions(segment: Segment) -> tuple[Floats, bool]:
    """Quaternions (n, 4), scalar last, and True if they are from A to B."""
    is_old = segment.version == '1.0'
    is_a_to_b = not is_old or _keyword(segment, 'ATTITUDE_DIR', 'A2B', 'B2A') == 'A2B'
    kind = _keyword(segment, 'ATTITUDE_TYPE')
    count = _TYPES[segment.version].get(kind)
    if count is None:
        raise ValueError(f'attitudes of type {kind}, not QUATERNION: convert them')
    values = _numbers(segment, (count,))[:, :4]
    if is_old and _keyword(segment, 'QUATERNION_TYPE', 'FIRST', 'LAST') == 'FIRST':
        values = np.roll(values, -1, axis=1)
    return values, is_a_to_b


def _numbers(segment: Segment, counts: Sequence[int]) -> Floats:
    """Numbers (n, k) of a segment; k is the same for all epochs and one of ``counts``."""
    if not segment.values:
        raise ValueError('a segment without data')
    count = len(segment.values[0])
    odd = [k for k, values in enumerate(segment.values) if len(values) != count]
    if odd or count not in counts:
        k = odd[0] if odd else 0
        raise ValueError(
            f'{len(segment.values[k])} numbers at {segment.epochs[k]}, expected '
            f'{" or ".join(map(str, counts))}'
        )
    values = np.array(segment.values)
    if not np.isfinite(values).all():
        k = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise ValueError(f'a number at {segment.epochs[k]} is not finite')
    return values


def _system(segment: Segment) -> str:
    return system_of(_keyword(segment, 'TIME_SYSTEM'))


def _stamps(segment: Segment, system: str) -> Indices:
    return np.array([from_text(epoch, system) for epoch in segment.epochs], np.int64)


def _useable(segment: Segment, at: Indices, system: str) -> NDArray[np.bool_]:
    """Mask of stamps in the usable span of a segment; outer states are for interpolation only."""
    keep = np.ones(len(at), np.bool_)
    if 'USEABLE_START_TIME' in segment.metadata:
        keep &= at >= from_text(segment.metadata['USEABLE_START_TIME'], system)
    if 'USEABLE_STOP_TIME' in segment.metadata:
        keep &= at <= from_text(segment.metadata['USEABLE_STOP_TIME'], system)
    return keep


def _center_velocity(center: str, at_ns: Indices) -> Floats:
    """Barycentric velocities (n, 3) of the centre of an ephemeris, m/s, ICRF axes."""
    name = center.strip().upper()
    if name in ('SOLAR SYSTEM BARYCENTER', 'SSB', 'SOLAR_SYSTEM_BARYCENTER'):
        return np.zeros((len(at_ns), 3))
    if name not in ('EARTH', 'SUN'):
        raise ValueError(
            f'centre {center!r} is not EARTH, SUN or SOLAR SYSTEM BARYCENTER; give the '
            'velocity as SPK kernels with a planetary ephemeris'
        )
    velocity = []
    for time_ns in at_ns:
        heliocentric, barycentric = erfa.epv00(*tt_julian_date(int(time_ns)))
        of_center = barycentric['v'] - (heliocentric['v'] if name == 'SUN' else 0.0)
        velocity.append(of_center * (AU_M / _DAY_S))
    return np.array(velocity).reshape(-1, 3)


_VERSION = re.compile(r'CCSDS_([A-Z]+)_VERS\s*=\s*(\S*)')
_ALL = (
    'OBJECT_NAME OBJECT_ID CENTER_NAME TIME_SYSTEM START_TIME USEABLE_START_TIME'
    ' USEABLE_STOP_TIME STOP_TIME INTERPOLATION_DEGREE'
)
_AEM = f'{_ALL} REF_FRAME_A REF_FRAME_B ATTITUDE_TYPE EULER_ROT_SEQ INTERPOLATION_METHOD'
_OEM = frozenset(f'{_ALL} REF_FRAME REF_FRAME_EPOCH INTERPOLATION'.split())
_KEYWORDS = {
    ('AEM', '1.0'): frozenset(f'{_AEM} ATTITUDE_DIR QUATERNION_TYPE RATE_FRAME'.split()),
    ('AEM', '2.0'): frozenset(f'{_AEM} ANGVEL_FRAME'.split()),
    **{('OEM', version): _OEM for version in ('1.0', '2.0', '3.0')},
}


# The section after a line in another one, and the section that a message ends in.
_STEPS = {
    'AEM': {
        ('header', 'META_START'): 'metadata',
        ('metadata', 'META_STOP'): 'place before DATA_START',
        ('place before DATA_START', 'DATA_START'): 'data',
        ('data', 'DATA_STOP'): 'header',
    },
    'OEM': {
        ('header', 'META_START'): 'metadata',
        ('metadata', 'META_STOP'): 'data',
        ('data', 'COVARIANCE_START'): 'covariance',
        ('covariance', 'COVARIANCE_STOP'): 'data',
        ('data', 'META_START'): 'metadata',
    },
}
_END = {'AEM': 'header', 'OEM': 'data'}


@dataclass
class Segment:
    """
    Segment of a message.

    ``values`` has one row for each of ``epochs``: the numbers of its line.
    """

    version: str
    metadata: dict[str, str] = field(default_factory=dict)
    epochs: list[str] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


def read_segments(path: Path, kind: str) -> list[Segment]:
    """
    Segments of an AEM or OEM, as ``kind`` states.

    Raises IngestError for another message, version or keyword, and for a message that is
    truncated.
    """
    text = mission_records.text_of(path)
    try:
        if text.lstrip().startswith('<'):
            raise ValueError('it is XML: convert it to KVN (the package ccsds-ndm does)')
        segments = _kvn_segments(text, kind)
        if not segments:
            raise ValueError('no segment')
        for segment in segments:
            _check(segment, kind)
    except ValueError as error:
        raise IngestError(f'{path}: not readable as CCSDS {kind}: {error}') from error
    return segments


def _check(segment: Segment, kind: str) -> None:
    keywords = _KEYWORDS.get((kind, segment.version))
    if keywords is None:
        known = ' or '.join(version for name, version in _KEYWORDS if name == kind)
        raise ValueError(f'version {segment.version!r} is not {known}')
    unknown = [key for key in segment.metadata if key not in keywords]
    if unknown:
        raise ValueError(f'version {segment.version} has no keyword {unknown[0]}')


def _kvn_segments(text: str, kind: str) -> list[Segment]:
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    used = ((n, line) for n, line in lines if line and not line.startswith('COMMENT'))
    _, first = next(used, (0, ''))
    version = _VERSION.fullmatch(first)
    if not version or version[1] != kind:
        raise ValueError(f'it begins with {first[:60]!r}, not with CCSDS_{kind}_VERS')
    segments: list[Segment] = []
    section = 'header'
    for number, line in used:
        if after := _STEPS[kind].get((section, line)):
            section = after
            if line == 'META_START':
                segments.append(Segment(version[2]))
            continue
        try:
            _kvn_line(section, line, segments)
        except ValueError as error:
            raise ValueError(f'line {number}, in the {section}: {error}') from error
    if section != _END[kind]:
        raise ValueError(f'it ends in the {section}: truncated?')
    return segments


def _kvn_line(section: str, line: str, segments: list[Segment]) -> None:
    if section == 'data':
        epoch, *numbers = line.split()
        segments[-1].values.append(tuple(map(float, numbers)))
        segments[-1].epochs.append(epoch)
    elif section != 'covariance':
        key, equals, value = map(str.strip, line.partition('='))
        if not equals or section not in ('header', 'metadata'):
            raise ValueError(f'{line[:60]!r} is out of place')
        if section == 'metadata':
            if key in segments[-1].metadata:
                raise ValueError(f'keyword {key} is given twice')
            segments[-1].metadata[key] = value
