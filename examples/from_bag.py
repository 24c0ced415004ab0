# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrate a camera from a bag: ``python from_bag.py BAG PARAMS CALIBRATION_JSON``."""

from __future__ import annotations

import sys

import starcal_ground


def main() -> int:
    """Calibrate; the exit status is 2 for bad input and 3 for a refused calibration."""
    if len(sys.argv) != 4:
        print('usage: python from_bag.py BAG PARAMS CALIBRATION_JSON', file=sys.stderr)
        return 2
    bag, params, output = sys.argv[1:]
    try:
        calibration = starcal_ground.calibrate_bag(bag, params)
    except starcal_ground.StarcalError as error:
        print(error, file=sys.stderr)
        return 2
    starcal_ground.write_calibration(calibration, output)

    camera = starcal_ground.read_calibration(output).geometry.camera
    for name, value, sigma in zip(
        camera.parameter_names, camera.parameters, calibration.sigma, strict=False
    ):
        print(f'{name:<5} {value:12.6g}  sigma {sigma:.2g}')
    if not calibration.accepted:
        print('refused:', ', '.join(calibration.reasons))
        return 3
    return 0


if __name__ == '__main__':
    sys.exit(main())
