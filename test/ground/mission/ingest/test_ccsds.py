# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
AEM and OEM of the kinds that other projects have among their test data, read or refused.

Each case is written here from the standards: CCSDS 504.0-B-1 and B-2, 502.0-B-1 to B-3, 505.0-B.
Its name states the project whose files have the feature, its comment the reason of the result.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from starcal_ground.images.time_systems import from_text
from starcal_ground.mission.ingest import sources
from starcal_ground.mission.ingest.mission_records import Attitudes, Velocities
from starcal_ros.errors import IngestError

# Orientation of the star tracker in the ICRF; as a transformation of coordinates, ICRF to tracker.
XYZW = (0.1825741858350554, 0.3651483716701107, 0.5477225575051661, 0.7302967433402214)
T = ('2026-05-15T07:20:00.0', '2026-05-15T07:20:10.0')
AT_NS = [from_text(T[0], 'UTC') + 4 * 10**9]
VELOCITY_KM_S = (1.0, -28.5, 5.25)

FORWARD = ' '.join(map(repr, XYZW))
BACKWARD = ' '.join(map(repr, (*(-part for part in XYZW[:3]), XYZW[3])))
FIRST = ' '.join(map(repr, (XYZW[3], *XYZW[:3])))


OLD = {'ATTITUDE_DIR': 'A2B', 'QUATERNION_TYPE': 'LAST'}
HEAD = 'CREATION_DATE = 2026-05-15T07:00:00\nORIGINATOR = TEST\n'
Changes = Mapping[str, str | None]


def message(kind: str, version: str, head: str, changes: Changes, data: str) -> str:
    """A message in KVN of one segment; a change to None removes a keyword."""
    keywords = {'OBJECT_NAME': 'SAT', 'OBJECT_ID': '2026-001A', 'TIME_SYSTEM': 'UTC', **changes}
    metadata = ''.join(f'{key} = {value}\n' for key, value in keywords.items() if value)
    return f'CCSDS_{kind}_VERS = {version}\n{head}META_START\n{metadata}META_STOP\n{data}'


def aem(
    version: str,
    changes: Changes,
    line: str = FORWARD,
    head: str = HEAD,
    times: tuple[str, str] = T,
) -> str:
    keywords = {
        'CENTER_NAME': 'EARTH',
        'REF_FRAME_A': 'ICRF',
        'REF_FRAME_B': 'STARTRACKER_1',
        'START_TIME': times[0],
        'STOP_TIME': times[1],
        'ATTITUDE_TYPE': 'QUATERNION',
        **(OLD if version == '1.0' else {}),
    }
    data = ''.join(f'{time} {line}\n' for time in times)
    data = f'DATA_START\n{data}DATA_STOP\n'
    return message('AEM', version, head, {**keywords, **changes}, data)


GMAT = {'CENTER_NAME': 'Earth', 'INTERPOLATION_METHOD': 'Linear', 'INTERPOLATION_DEGREE': '7'}
TO_ICRF = {'REF_FRAME_A': 'SC_BODY_1', 'REF_FRAME_B': 'J2000', 'ANGVEL_FRAME': 'REF_FRAME_B'}

ATTITUDES = {
    # 1.0 of an exporter without OBJECT_ID: nothing here needs it.
    'gmat': aem('1.0', {**GMAT, 'OBJECT_ID': None}).replace(' = ', '          = '),
    # Values are all upper or all lower case (504.0-B-2, 6.8), and 2.0 is scalar last.
    'lower case': aem('2.0', {'ATTITUDE_TYPE': 'quaternion', 'TIME_SYSTEM': 'utc'}),
    # Table 4-4 of B-2: three numbers more; frames from tracker to J2000.
    'brahe angvel': aem('2.0', {**TO_ICRF, 'ATTITUDE_TYPE': 'QUATERNION/ANGVEL'},
                        f'{BACKWARD} 0.1 0.2 0.3', 'MESSAGE_ID = A7015Z3\n'),
    # Table 4-4 of B-1: the rates follow the quaternion, whose order QUATERNION_TYPE states.
    'orekit derivative': aem('1.0', {'ATTITUDE_TYPE': 'QUATERNION/DERIVATIVE',
                                     'QUATERNION_TYPE': 'FIRST'}, f'{FIRST} 0 0.1 0.1 0.1'),
    'orekit rate': aem('1.0', {'ATTITUDE_TYPE': 'QUATERNION/RATE', 'RATE_FRAME': 'REF_FRAME_B',
                               'ATTITUDE_DIR': 'B2A'}, f'{BACKWARD} 0.001 0.002 0.003'),
    # Day of the year and Z (6.8.9); comments begin sections, and a space may begin a line.
    'orekit times': aem('1.0', {}, times=('2026-135T07:20:00.0Z', '2026-135T07:20:10Z'),
                        head='COMMENT one\nCREATION_DATE = 2026-135T00:00:00\n')
    .replace('DATA_START\n', 'DATA_START\nCOMMENT from a filter\n   '),
    # Tests of gmat-run have both: a byte-order mark and CR LF are no part of the text.
    'byte-order mark': '\ufeff' + aem('1.0', {}).replace('\n', '\r\n'),
}  # fmt: skip

REFUSED_ATTITUDES = {
    # B-1 makes it conditional: with quaternions there is no default.
    'gmat without order': (aem('1.0', {'QUATERNION_TYPE': None}), 'QUATERNION_TYPE is missing'),
    'euler angles': (aem('1.0', {'ATTITUDE_TYPE': 'EULER_ANGLE', 'EULER_ROT_SEQ': '321'},
                         '1 2 3'), 'EULER_ANGLE, not QUATERNION: convert'),
    'order': (aem('1.0', {'QUATERNION_TYPE': 'SCALAR'}), 'requires it FIRST or LAST'),
    'ccsds-ndm without direction': (aem('1.0', {'ATTITUDE_DIR': None}), 'ATTITUDE_DIR is missing'),
    # Only the keywords of the table (B-2, 4.2.3): the direction is always A to B there.
    'orekit direction': (aem('2.0', {'ATTITUDE_DIR': 'B2A'}), '2.0 has no keyword ATTITUDE_DIR'),
    'direction first': (
        aem('2.0', {'ATTITUDE_TYPE': None, 'ATTITUDE_DIR': 'B2A'}).replace(
            'META_STOP', 'ATTITUDE_TYPE = QUATERNION\nMETA_STOP'
        ),
        '2.0 has no keyword ATTITUDE_DIR',
    ),
    'orekit order': (aem('2.0', {'QUATERNION_TYPE': 'FIRST'}), 'no keyword QUATERNION_TYPE'),
    'orekit keyword': (aem('1.0', {'WRONG_KEYWORD': '123'}), '1.0 has no keyword WRONG_KEYWORD'),
    'orekit no type': (aem('1.0', {'ATTITUDE_TYPE': None}), 'ATTITUDE_TYPE is missing'),
    'orekit spin': (aem('1.0', {'ATTITUDE_TYPE': 'SPIN'}), 'SPIN, not QUATERNION: convert'),
    'rate of 1.0': (aem('2.0', {'ATTITUDE_TYPE': 'QUATERNION/RATE'}), 'type QUATERNION/RATE'),
    'orekit number': (aem('1.0', {}, '0.4 nothing 0.2 0.7'), 'line 18, in the data: .*nothing'),
    'orekit keyword in data': (
        aem('1.0', {}).replace('DATA_STOP', 'USER = bad\nDATA_STOP'), 'line 20, in the data'
    ),
    'orekit second metadata': (
        aem('1.0', {}).replace('DATA_START', 'META_START'), "'META_START' is out of place"
    ),
    'twice': (aem('1.0', {}).replace('META_STOP', 'TIME_SYSTEM = TAI\nMETA_STOP'), 'given twice'),
    # The type alone gives the meaning of a number.
    'astro width': (aem('2.0', {}, f'{FORWARD} 0.1 0.2 0.3'), '7 numbers at .*, expected 4'),
    'not finite': (aem('2.0', {}, '0 0 nan 1'), 'is not finite'),
    'no data': (aem('2.0', {}, 'x').replace(f'{T[0]} x\n{T[1]} x\n', ''), 'without data'),
    'another message': ('CCSDS_APM_VERS = 2.0\n', 'not with CCSDS_AEM_VERS'),
    'xml': ('<?xml version="1.0"?>\n<aem/>', 'it is XML: convert it to KVN'),
    'version 3': (aem('3.0', {}), "version '3.0' is not 1.0 or 2.0"),
    'unknown times': (aem('1.0', {'TIME_SYSTEM': 'MET'}), 'MET'),
    'unknown frame': (aem('1.0', {'REF_FRAME_A': 'TEME'}), 'one must be ICRF or EME2000'),
    'no tracker': (aem('1.0', {'REF_FRAME_B': 'EME2000'}), 'one must be ICRF'),
    'no date': (aem('1.0', {}, times=('2026-05-15T99:20:00', T[1])), 'is not a date and time'),
}  # fmt: skip


def attitudes(folder: Path, text: str) -> Attitudes:
    (folder / 'a.aem').write_bytes(text.encode())
    return sources.attitudes([folder / 'a.aem'], '', AT_NS)


@pytest.mark.parametrize('text', ATTITUDES.values(), ids=ATTITUDES)
def test_an_aem_that_is_valid_is_read(tmp_path, text) -> None:
    found = attitudes(tmp_path, text)
    assert found.time_ns.tolist() == [from_text(time, 'UTC') for time in T]
    np.testing.assert_allclose(found.icrf_from_star_tracker_xyzw, [XYZW, XYZW], atol=1e-15)


def test_an_aem_is_read_within_its_useable_span_and_not_where_it_is_cut(tmp_path) -> None:
    found = attitudes(tmp_path, aem('2.0', {'USEABLE_STOP_TIME': '2026-05-15T07:20:05'}))
    assert found.time_ns.tolist() == [from_text(T[0], 'UTC')]
    text = aem('1.0', {})
    for count in range(len('CCSDS_AEM_VERS ='), len(text) - 1):
        with pytest.raises(IngestError) as error:
            attitudes(tmp_path, text[:count])
        assert '\n' not in str(error.value)


def oem(version: str, changes: Changes, more: str = '', end: str = '', head: str = HEAD) -> str:
    """An OEM of an even motion about the barycentre."""
    keywords = {'CENTER_NAME': 'SOLAR SYSTEM BARYCENTER', 'REF_FRAME': 'ICRF'}
    span = {'START_TIME': T[0], 'STOP_TIME': T[1]}
    data = ''.join(
        f'{time} {state(seconds)}{more}\n' for time, seconds in zip(T, (0, 10), strict=True)
    )
    return message('OEM', version, head, {**keywords, **span, **changes}, f'{data}{end}')


def state(seconds: float) -> str:
    position = [1.5e8 + VELOCITY_KM_S[0] * seconds, *np.multiply(VELOCITY_KM_S[1:], seconds)]
    return ' '.join(map(repr, map(float, (*position, *VELOCITY_KM_S))))


COVARIANCE = (
    'COVARIANCE_START\nEPOCH = 2026-05-15T07:20:00\nCOV_REF_FRAME = RTN\n0.1\n0.1 0.2\n'
    'COVARIANCE_STOP\n'
)
STK = {'OBJECT_ID': '2000-000A', 'INTERPOLATION': 'LAGRANGE', 'INTERPOLATION_DEGREE': '5',
       'USEABLE_START_TIME': T[0], 'USEABLE_STOP_TIME': T[1]}  # fmt: skip

VELOCITIES = {
    # 502.0-B-1 differs from B-2 by its version alone in these keywords.
    'stk 1.0': oem('1.0', STK),
    # Comments and empty lines between the sections.
    'oem real': oem('2.0', STK, head='\nCOMMENT DE-430\n\nCREATION_DATE = 2026-05-15T00:00:00\n'),
    'orekit lower case': oem('2.0', {'REF_FRAME': 'icrf', 'TIME_SYSTEM': 'utc'}),
    # B-2, 5.2.5: a covariance follows the states of a segment.
    'oem covariance': oem('2.0', {}, end=COVARIANCE),
    # B-2, table 5-3: accelerations are optional.
    'spacetools acceleration': oem('3.0', {}, ' 0 0 0', head='CLASSIFICATION = PUBLIC\n'),
}

REFUSED_VELOCITIES = {
    'another centre': (oem('2.0', {'CENTER_NAME': 'MOON'}), 'MOON'),
    'another time': (oem('2.0', {}).replace('T07', 'T08'), 'no velocity for 1 of 1 images'),
    'frame of date': (oem('2.0', {'REF_FRAME': 'TOD'}), 'neither ICRF nor EME2000'),
    'orekit keyword': (oem('2.0', {'WRONG_KEYWORD': '1'}), '2.0 has no keyword WRONG_KEYWORD'),
    'orekit keyword in data': (oem('2.0', {}, end='KEY = 1\n'), 'line 15, in the data'),
    'oem no time system': (oem('2.0', {'TIME_SYSTEM': None}), 'TIME_SYSTEM is missing'),
    'oem columns': (oem('2.0', {}, ' 0'), '7 numbers at .*, expected 6 or 9'),
    'position alone': (
        oem('2.0', {}).replace(state(10), '1 2 3'), '3 numbers at 2026-05-15T07:20:10.0'
    ),
    'covariance cut': (oem('2.0', {}, end=COVARIANCE[:60]), 'ends in the covariance: truncated'),
    'unusable': (oem('2.0', {**STK, 'USEABLE_STOP_TIME': T[0]}), 'no velocity for 1 of 1'),
    'aem': (aem('2.0', {}), 'not with CCSDS_OEM_VERS'),
}  # fmt: skip


def velocities(folder: Path, text: str) -> Velocities:
    (folder / 'a.oem').write_bytes(text.encode())
    return sources.velocities([folder / 'a.oem'], '', AT_NS)


@pytest.mark.parametrize('text', VELOCITIES.values(), ids=VELOCITIES)
def test_an_oem_that_is_valid_is_read(tmp_path, text) -> None:
    found = velocities(tmp_path, text)
    # Positions of 1.5e8 km have a resolution of 3e-8 km, over 10 s 3e-6 m/s.
    np.testing.assert_allclose(found.velocity_m_s, [np.multiply(VELOCITY_KM_S, 1e3)], atol=2e-5)


@pytest.mark.parametrize(
    ('read', 'text', 'why'),
    [(attitudes, *case) for case in REFUSED_ATTITUDES.values()]
    + [(velocities, *case) for case in REFUSED_VELOCITIES.values()],
    ids=[*REFUSED_ATTITUDES, *REFUSED_VELOCITIES],
)
def test_one_that_is_ambiguous_or_invalid_is_refused(tmp_path, read, text, why) -> None:
    with pytest.raises(IngestError, match=why) as error:
        read(tmp_path, text)
    assert f'{tmp_path}/a.' in str(error.value) and '\n' not in str(error.value)
