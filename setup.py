# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The pip side of the package; its version has one home, package.xml."""

from pathlib import Path
from xml.etree import ElementTree

from setuptools import setup

ROOT = Path(__file__).parent

setup(
    version=ElementTree.parse(ROOT / 'package.xml').findtext('version'),
    # The bag reader parses these definitions; in a ROS workspace CMake installs them there.
    data_files=[
        ('share/starcal/msg', sorted(str(p.relative_to(ROOT)) for p in ROOT.glob('msg/*.msg')))
    ],
)
# Metadata and console scripts are in setup.cfg, because ament_cmake_python reads that one only.
