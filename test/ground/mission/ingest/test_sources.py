# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes and velocities from CCSDS, SPICE and tables, each written by its own library."""

from pathlib import Path

from mission_files import (  # type: ignore[import-not-found]
    attitudes,
    date,
    FRAME_ID,
    images,
    write_aem,
    write_ck,
    write_lsk,
    write_spk,
)
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import spiceypy

from starcal_ground.mission.ingest import sources
from starcal_ground.mission.ingest.mission_records import Attitudes, EME2000_NOTE
from starcal_ros.errors import IngestError
from starcal_ros.sky.astrometry import earth_velocity_c

AT_NS = [image.time_ns for image in images()]
LIGHT_M_S = 299792458.0


def worst_rad(found: Attitudes, expected: tuple) -> float:
    a = Rotation.from_quat(found.icrf_from_star_tracker_xyzw)
    b = Rotation.from_quat(np.array([xyzw for _, xyzw in expected]))
    return float((a.inv() * b).magnitude().max())


@pytest.mark.parametrize('version', ['1.0', '2.0'])
@pytest.mark.parametrize('system', ['utc', 'tai', 'tdb', 'gps'])
def test_an_aem_gives_the_attitudes_of_the_bag(tmp_path, system, version) -> None:
    path = write_aem(tmp_path / 'a.aem', system, version=version)
    found = sources.attitudes([path], '', AT_NS)
    stamps = np.array([time_ns for time_ns, _ in attitudes()])
    # A double of astropy holds a day to 1e-11 s; TDB by ERFA on both sides.
    assert np.abs(found.time_ns - stamps).max() <= (0 if system == 'utc' else 20)
    assert worst_rad(found, attitudes()) < 1e-15 + 3e-16  # repr() keeps every bit
    assert (system == 'utc') == (not found.notes)


def test_the_direction_is_that_of_spice_and_eme2000_is_named(tmp_path) -> None:
    """The matrix of CCSDS 504.0-B from Q1..QC is SPICE's C-matrix, inertial to body."""
    _, (q1, q2, q3, qc) = attitudes()[0]
    M = np.array([
        [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
        [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
        [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
    ])  # fmt: skip
    found = sources.attitudes([write_aem(tmp_path / 'a.aem', frame='EME2000')], '', AT_NS)
    turn = Rotation.from_quat(found.icrf_from_star_tracker_xyzw[0])
    assert np.abs(turn.as_matrix() - M.T).max() < 1e-15
    assert found.notes == (EME2000_NOTE,) and '20 mas' in EME2000_NOTE


@pytest.mark.parametrize('frame', [str(FRAME_ID), 'ST1'])
def test_a_ck_gives_the_attitudes_of_the_bag(tmp_path, frame) -> None:
    kernels = write_ck(tmp_path)
    if frame == 'ST1':
        fk = tmp_path / 'mission.tf'
        fk.write_text(
            f"KPL/FK\n\\begindata\nFRAME_ST1 = {FRAME_ID}\nFRAME_{FRAME_ID}_NAME = 'ST1'\n"
            f'FRAME_{FRAME_ID}_CLASS = 3\nFRAME_{FRAME_ID}_CLASS_ID = {FRAME_ID}\n'
            f'FRAME_{FRAME_ID}_CENTER = -999\nCK_{FRAME_ID}_SCLK = -999\n\\begintext\n'
        )
        kernels.append(fk)
    samples = attitudes()[2:5]
    found = sources.attitudes(kernels, frame, [time_ns for time_ns, _ in samples])
    at = np.searchsorted(found.time_ns, [time_ns for time_ns, _ in samples])
    exact = Attitudes(found.time_ns[at], found.icrf_from_star_tracker_xyzw[at])
    # A tick of the clock is 0.1 ms and fractions of it count; ET resolves 0.1 us, in which the
    # camera of the bag turns by under 1e-9 rad.
    assert worst_rad(exact, samples) < 1e-9
    assert spiceypy.ktotal('ALL') == 0  # nothing stays loaded


def test_an_spk_gives_the_velocity(tmp_path) -> None:
    lsk = write_lsk(tmp_path / 'leap.tls')
    spk = write_spk(tmp_path / 'orbit.bsp', lsk, [1.0, -28.0, 5.0])
    found = sources.velocities([spk, lsk], '-999', AT_NS)
    np.testing.assert_allclose(found.velocity_m_s, [[1e3, -28e3, 5e3]] * len(AT_NS), rtol=1e-9)


def oem(path: Path, center: str, frame: str = 'ICRF') -> Path:
    """A circular orbit of 7000 km about a centre, a state a minute, in the plane x, y."""
    n = np.sqrt(398600.4418 / 7000.0**3)
    lines = [
        'CCSDS_OEM_VERS = 2.0', 'CREATION_DATE = 2026-05-15T07:00:00', 'ORIGINATOR = TEST',
        'META_START', 'OBJECT_NAME = MSN', 'OBJECT_ID = 2026-001A', f'CENTER_NAME = {center}',
        f'REF_FRAME = {frame}', 'TIME_SYSTEM = UTC', f'START_TIME = {date(AT_NS[0] - 60 * 10**9)}',
        f'STOP_TIME = {date(AT_NS[0] + 120 * 10**9)}', 'META_STOP',
    ]  # fmt: skip
    for k in range(4):
        angle = n * 60.0 * (k - 1)
        x, y, v = 7000 * np.cos(angle), 7000 * np.sin(angle), 7000 * n
        values = (x, y, 0.0, -v * np.sin(angle), v * np.cos(angle), 0.0)
        epoch = date(AT_NS[0] + (k - 1) * 60 * 10**9)
        lines.append(' '.join([epoch, *(f'{value:.12f}' for value in values)]))
    path.write_text('\n'.join(lines) + '\n')
    return path


def test_an_oem_is_interpolated_and_the_earth_added(tmp_path) -> None:
    about_earth = sources.velocities([oem(tmp_path / 'a.oem', 'EARTH')], '', AT_NS)
    about_ssb = sources.velocities([oem(tmp_path / 'b.oem', 'SOLAR SYSTEM BARYCENTER')], '', AT_NS)
    earth = [earth_velocity_c(time_ns) * LIGHT_M_S for time_ns in AT_NS]
    difference = about_earth.velocity_m_s - about_ssb.velocity_m_s
    np.testing.assert_allclose(difference, earth, atol=1e-6)
    n = np.sqrt(398600.4418 / 7000.0**3)
    angle = n * (np.array(AT_NS) - AT_NS[0]) * 1e-9
    circle = 7e6 * n * np.c_[-np.sin(angle), np.cos(angle), 0 * angle]
    # A cubic over a minute of a low orbit: h^3 r'''' / 200 is 0.05 m/s, 4e-5 arcsec.
    assert np.abs(about_ssb.velocity_m_s - circle).max() < 0.1


@pytest.mark.parametrize('mark', [', ', ';', '\t', ' ; '])
@pytest.mark.parametrize('header', ['time_tdb qx qy qz qw', 'Time_TDB QX QY QZ QW'])
def test_tables_are_read(tmp_path, mark, header) -> None:
    lines = ['# from telemetry, or another program', mark.join(header.split())]
    lines += [mark.join([date(t, 'tdb'), *map(repr, q.tolist())]) for t, q in attitudes()]
    path = tmp_path / 'a.csv'
    path.write_text('\ufeff' + '\n'.join(lines) + '\n')
    assert worst_rad(sources.attitudes([path], '', AT_NS), attitudes()) < 1.3e-15
    path.write_text(f'time_ns,vx_m_s,vy_m_s,vz_m_s\n{AT_NS[0]},1,2,3\n')
    assert sources.velocities([path], '', AT_NS).velocity_m_s.tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('time_utc,qx,qy,qz,qw\n', 'no attitudes'),
        ('time_utc,qx,qy,qz\n2026-05-15T07:00,0,0,0\n', 'without the columns qw'),
        ('time_local,qx,qy,qz,qw\n2026-05-15T07:00,0,0,0,1\n', 'without the columns time_utc'),
        ('time_utc,qx,qy,qz,qw\n2026-05-15T07:00,0,0,0,2\n', 'not a unit quaternion'),
        ('time_utc,qx,qy,qz,qw\n2026-05-15T07:00,0,0,,1\n', 'line 2'),
        ('time_utc,qx,qy,qz,qw\n2026-05-15T07:00,0,0,nan,1\n', 'not all finite'),
        ('time_utc,qx,qy,qz,qw\nnoon,0,0,0,1\n', "line 2: 'noon'"),
        ('qx,qy,qz,qw,time_ns\n0,0,0,1\n', 'line 2'),
        ('time_ns,qx,qy,qz,qw\n-5,0,0,0,1\n', 'before 1972'),
    ],
)
def test_a_bad_table_is_one_line(tmp_path, text, words) -> None:
    path = tmp_path / 'a.csv'
    path.write_text(text)
    with pytest.raises(IngestError, match=words):
        sources.attitudes([path], '', AT_NS)


def test_kernels_that_do_not_cover_the_images_are_named(tmp_path) -> None:
    kernels = write_ck(tmp_path)
    later = [time_ns + 86400 * 10**9 for time_ns in AT_NS]
    with pytest.raises(IngestError, match='the CK does not cover the images'):
        sources.attitudes(kernels, str(FRAME_ID), later)
    with pytest.raises(IngestError, match='--star-tracker'):
        sources.attitudes(kernels, '', AT_NS)
    with pytest.raises(IngestError, match='no leap seconds kernel'):
        sources.attitudes(kernels[:2], str(FRAME_ID), AT_NS)
    with pytest.raises(IngestError, match='NOSUCH'):
        sources.attitudes(kernels, 'NOSUCH', AT_NS)
    spk = write_spk(tmp_path / 'orbit.bsp', kernels[2], [1.0, 2.0, 3.0])
    with pytest.raises(IngestError, match='no velocity of -999'):
        sources.velocities([spk, kernels[2]], '-999', later)
