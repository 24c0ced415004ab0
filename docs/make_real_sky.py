# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Draw the stars that starcal identifies in photographs: ``python -m docs.make_real_sky IMAGES DIR``.

The picture of the README is of the eight images in the folder ``test_data`` of tetra3
(https://github.com/esa/tetra3, European Space Agency, Apache License 2.0), a part of the one with
the most stars.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import tempfile

import cv2
import numpy as np

from docs.make_images import FOLDER, part_of
from starcal_ground.bags.reader import read_observations
from starcal_ground.cli import main as cli
from starcal_ground.images.photographs import image_paths
from starcal_ground.products import OBSERVATIONS_FILE, OBSERVATIONS_TOPIC
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import Image

WIDTH_PX = 810  # as drawn
PART = (0.6, 0.45)  # of the width and the height


def main() -> None:
    """Calibrate from the images alone, and draw."""
    parser = argparse.ArgumentParser(description='Draw the stars identified in photographs.')
    parser.add_argument('images', type=Path, metavar='IMAGES')
    parser.add_argument('folder', nargs='?', type=Path, default=FOLDER, metavar='DIR')
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        if cli.main(['calibrate', str(args.images), '-o', name, '--no-report']) != 0:
            raise SystemExit('no accepted calibration: nothing is drawn')
        observations = list(
            read_observations([Path(name) / OBSERVATIONS_FILE], OBSERVATIONS_TOPIC)
        )
        geometry = read_calibration(Path(name) / 'calibration.json').geometry
    # Without a time of its own an image has that of its file, and they are told apart by it.
    order = sorted(image_paths([args.images]), key=lambda path: path.stat().st_mtime_ns)
    shown = int(np.argmax([len(image) for image in observations]))
    pixels = cv2.imread(str(order[shown]), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    image = Image(observations[shown].time_ns, pixels.astype(np.uint16))
    height, width = pixels.shape
    size = round(PART[0] * width), round(PART[1] * height)
    first = (width - size[0]) // 2, (height - size[1]) // 2
    picture = part_of(image, observations[shown], geometry, first, size, WIDTH_PX)
    cv2.imwrite(
        str(args.folder / 'real_sky.png'), picture // 16 * 17, [cv2.IMWRITE_PNG_COMPRESSION, 9]
    )


if __name__ == '__main__':
    main()
