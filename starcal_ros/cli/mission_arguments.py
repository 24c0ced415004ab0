"""Arguments of the commands for missions: export, import and trend."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

HELP: dict[str, tuple[str, str, str]] = {
    'export': (
        'write a calibration in the format of another tool',
        (
            'Writes SPICE kernels (FK and IK), YAML of OpenCV, kalibr or ROS, arguments of GIANT, '
            'or a table of lines of sight; prints what the format cannot hold and its cost in '
            'pixels. SPICE kernels and tables hold everything.'
        ),
        """\
  # frame and instrument kernel; the star tracker frame is defined too
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-id -999100
  # with the frame names of the mission, whose frame kernel defines the star tracker
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-frame MSN_ST1
  # for cv2.projectPoints
  starcal export out --to opencv -o opencv""",
    ),
}


def _export(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    command.add_argument('calibration', type=Path, metavar='DIR', help=what)
    what = 'format: spice, opencv, kalibr, ros, giant or csv'
    command.add_argument('--to', required=True, metavar='FORMAT', help=what)
    what = 'folder for the files, created if absent'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='OUT', help=what)
    spice = command.add_argument_group('SPICE')
    what = 'NAIF ID of the spacecraft, negative'
    spice.add_argument('--spacecraft-id', type=int, metavar='ID', help=what)
    what = 'NAIF ID of the camera (default: 1000 times that of the spacecraft, minus 1)'
    spice.add_argument('--instrument-id', type=int, default=0, metavar='ID', help=what)
    what = (
        'frame ID of the star tracker; the kernel then defines its frame as a CK frame (default: '
        'the frame kernel of the mission does)'
    )
    spice.add_argument('--star-tracker-id', type=int, default=0, metavar='ID', help=what)
    for name in ('camera', 'star-tracker'):
        what = f'name of the {name.replace("-", " ")} frame (default: that of the calibration)'
        spice.add_argument(f'--{name}-frame', default='', metavar='NAME', help=what)
    what = 'pixel size, micrometres, for a focal length in mm (default: pixels only)'
    spice.add_argument('--pixel-size-um', type=float, default=0.0, metavar='UM', help=what)
    what = 'image topic, for kalibr'
    command.add_argument('--image-topic', default='', metavar='T', help=what)


ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {'export': _export}
