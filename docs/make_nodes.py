# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Draw the graph of the nodes: ``python -m docs.make_nodes [DIR]``.

The picture needs no script and no network at reading time, on the site and in the repository.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from starcal_ground.report.svg import arrow, Drawing, INK, MUTED, SERIES, words

FOLDER = Path(__file__).parent / 'images'
WIDTH, HEIGHT = 600, 410
Box = tuple[float, float, float, float]
OURS: dict[str, Box] = {'star_observer': (20, 100, 580, 136), 'calibrator': (20, 204, 300, 312)}
"""Left, top, right and bottom of the nodes of this package."""
OTHERS: dict[str, Box] = {
    'camera driver': (20, 10, 170, 46),
    'star tracker': (200, 10, 350, 46),
    'optional sources': (400, 10, 580, 46),
    'operator': (490, 204, 580, 312),
    'navigation': (20, 364, 580, 400),
}
TOPICS: tuple[tuple[tuple[float, float], tuple[float, float], tuple[str, ...]], ...] = (
    ((95, 46), (95, 100), ('image',)),
    ((275, 46), (275, 100), ('attitude',)),
    ((490, 46), (490, 100), ('velocity,', 'temperature')),
    ((70, 136), (70, 204), ('observations',)),
    ((215, 204), (215, 136), ('calibration',)),
    ((535, 136), (535, 204), ('annotated_image',)),
    ((490, 254), (300, 254), ()),
    ((300, 290), (490, 290), ('ensemble_status',)),
    ((160, 312), (160, 364), ('calibration, camera_info,', 'alignment, /tf_static')),
)
"""Start and end of each arrow, and the topics on it; the services are written beside theirs."""
SERVICES = ('~/calibrate, ~/solve,', '~/rollback, ~/reset')


def _box(name: str, box: Box, colour: str) -> str:
    left, top, right, bottom = box
    outline = f'M{left},{top}H{right}V{bottom}H{left}Z'
    return f'<path d="{outline}" fill="none" stroke="{colour}" stroke-width="1.5"/>' + words(
        (left + right) / 2, (top + bottom) / 2 + 4, name, colour=colour
    )


def _topic(start: tuple[float, float], end: tuple[float, float], names: tuple[str, ...]) -> str:
    shaft = arrow(np.array(start, float), np.subtract(end, start).astype(float), MUTED)
    is_level = start[1] == end[1]
    x, y = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
    if is_level:
        return shaft + ''.join(words(x, y - 8, name) for name in names)
    top = y + 4 - 8 * (len(names) - 1)
    side, anchor = (8, 'start') if x < WIDTH / 2 else (-8, 'end')
    return shaft + ''.join(
        words(x + side, top + 16 * k, name, anchor) for k, name in enumerate(names)
    )


def nodes() -> Drawing:
    """Draw the nodes, the topics between them and the services of the operator."""
    parts = [_box(name, box, SERIES[0]) for name, box in OURS.items()]
    parts += [_box(name, box, INK) for name, box in OTHERS.items()]
    parts += [_topic(*topic) for topic in TOPICS]
    parts += [words(395, 228 + 16 * k, names) for k, names in enumerate(SERVICES)]
    return Drawing(''.join(parts), HEIGHT, WIDTH)


def main() -> None:
    """Draw the graph."""
    parser = argparse.ArgumentParser(description='Draw the graph of the nodes.')
    parser.add_argument('folder', nargs='?', type=Path, default=FOLDER, metavar='DIR')
    (parser.parse_args().folder / 'nodes.svg').write_text(nodes().document())


if __name__ == '__main__':
    main()
