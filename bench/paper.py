# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
`starcal calibrate` on the campaign of the paper: 359 images of 2592 x 2048, bag to products.

The bag has 3.8 GB and takes minutes to render; it is deleted at the end.  A fourth of the images
is calibrated first, to check that memory does not grow with their number.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
import tempfile

from bench.calibrate import time_command
from bench.table import Table
from starcal_ros.simulation import bag as simulated_bag
from starcal_ros.simulation import scenario as synthetic

TARGET_S = 60.0


def run(quick: bool) -> list[Table]:
    """Render a bag of each length and time the calibration from it."""
    scenario = synthetic.scenario('paper')
    lengths = (4, 8) if quick else (scenario.image_count // 4, scenario.image_count)
    tables = []
    for count in lengths:
        print(f'paper: rendering {count} images', flush=True)
        with tempfile.TemporaryDirectory() as folder:
            shorter = dataclasses.replace(scenario, image_count=count)
            made = simulated_bag.write_bag(shorter, Path(folder, 'bag'))
            command = ['-m', 'starcal_ros.cli.main', 'calibrate', str(made.bag)]
            command += ['--params', str(made.params), '-o', str(Path(folder, 'out'))]
            tables.append(time_command('paper', count, command, 1, TARGET_S))
        print(tables[-1].text(), flush=True)
    return tables
