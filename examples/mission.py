# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
From FITS images and a CCSDS attitude file to SPICE kernels, and a check of these with spiceypy.

Run: python mission.py BAG PARAMS DIR, for example with bags/tiny.  BAG stands for a mission here:
its images become FITS files and its attitudes an AEM.  Needs pip install '.[mission]'.
"""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from astropy.io import fits
from mcap_ros2.reader import read_ros2_messages
import numpy as np
import spiceypy
import yaml

import starcal_ground


def utc(stamp: Any) -> str:
    """Date and time of a ROS stamp, to the nanosecond."""
    seconds = datetime.fromtimestamp(stamp.sec, timezone.utc)
    return f'{seconds:%Y-%m-%dT%H:%M:%S}.{stamp.nanosec:09d}'


def write_mission_files(bag: Path, folder: Path) -> None:
    """Write the images of a bag as FITS files and its attitudes as an AEM."""
    samples = []
    (file,) = bag.glob('*.mcap')
    for message in read_ros2_messages(file):
        ros = message.ros_msg
        if message.channel.topic == '/opnav/image_raw':
            order = '>' if ros.is_bigendian else '<'
            pixels = np.frombuffer(ros.data, f'{order}u2').reshape(ros.height, ros.width)
            hdu = fits.PrimaryHDU(pixels)
            hdu.header['DATE-AVG'] = utc(ros.header.stamp)
            hdu.writeto(folder / f'{ros.header.stamp.sec}.fits', overwrite=True)
        elif message.channel.topic == '/star_tracker/attitude':
            q, date = ros.quaternion, utc(ros.header.stamp)
            samples.append((date, f'{date} {q.x!r} {q.y!r} {q.z!r} {q.w!r}'))
    header = f"""CCSDS_AEM_VERS = 1.0
CREATION_DATE = {samples[0][0]}
ORIGINATOR = EXAMPLE
META_START
OBJECT_NAME = EXAMPLE
OBJECT_ID = 2026-001A
CENTER_NAME = EARTH
REF_FRAME_A = ICRF
REF_FRAME_B = STARTRACKER_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = UTC
START_TIME = {samples[0][0]}
STOP_TIME = {samples[-1][0]}
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP
DATA_START
"""
    text = header + '\n'.join(line for _, line in samples) + '\nDATA_STOP\n'
    (folder / 'attitude.aem').write_text(text)


def run(*words: object) -> None:
    """One command of the tool, beside this Python or on the path; ends the script if it fails."""
    tool = shutil.which('starcal', path=Path(sys.executable).parent) or 'starcal'
    if subprocess.run([tool, *map(str, words)]).returncode:
        sys.exit(1)


def main() -> int:
    """Import, calibrate, export, and read the kernels."""
    if len(sys.argv) != 4:
        print('usage: python mission.py BAG PARAMS DIR', file=sys.stderr)
        return 2
    bag, params, folder = map(Path, sys.argv[1:])
    folder.mkdir(parents=True, exist_ok=True)
    write_mission_files(bag, folder)
    values = yaml.safe_load(params.read_text())['/**']['ros__parameters']
    run(
        'import', '--images', folder / '*.fits', '--attitude', folder / 'attitude.aem',
        '-o', folder / 'bag', '--camera', params.parent / values['camera_info_url'],
        '--alignment', *values['prior_alignment'],
    )  # fmt: skip
    run('calibrate', folder / 'bag', '--params', folder / 'bag/params.yaml', '-o', folder / 'out')
    run(
        'export', folder / 'out', '--to', 'spice', '-o', folder,
        '--spacecraft-id', -999, '--star-tracker-id', -999100,
    )  # fmt: skip

    for kernel in ('camera.tf', 'camera.ti'):
        spiceypy.furnsh(str(folder / kernel))
    _, frame, boresight, _, _ = spiceypy.getfov(-999001, 100)
    in_tracker = spiceypy.pxform(frame, 'STAR_TRACKER', 0.0) @ boresight

    calibration = starcal_ground.read_calibration(folder / 'out')
    camera = calibration.geometry.camera
    middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    expected = starcal_ground.lines_of_sight(calibration, middle, frame='star_tracker')
    print('boresight in the star tracker frame, by SPICE:', *np.round(in_tracker, 9))
    print(f'difference from the calibration: {np.linalg.norm(in_tracker - expected):.1e} rad')
    return 0


if __name__ == '__main__':
    sys.exit(main())
