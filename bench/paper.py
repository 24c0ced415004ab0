# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
`starcal calibrate` on the campaign of the paper: 359 images of 2592 x 2048, bag to report.

The bag has 3.8 GB decompressed and takes minutes to render; it is deleted at the end.  A fourth of
the images is calibrated first, to check that memory does not grow with their number.
"""

from __future__ import annotations

from bench.calibrate import compare
from bench.table import Table
from starcal_ros.studies.simulation import scenario as synthetic

MOST_RATIO = 2.0


def run(quick: bool) -> list[Table]:
    """Render a bag of each length and compare a calibration of it with a bare read."""
    images = synthetic.scenario('paper').image_count
    if quick:
        return [table for count in (4, 8) for table in compare('paper', count, None, None, 1)]
    return [
        *compare('paper', images // 4, None, None, 2),
        *compare('paper', images, None, MOST_RATIO, 3),
    ]
