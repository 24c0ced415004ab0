"""Commands for missions: export."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
import math
from pathlib import Path

from starcal_ros.errors import OptionError


def _export(args: argparse.Namespace) -> int:
    """Write a calibration in the format of another tool."""
    from starcal_ros.export.formats import export
    from starcal_ros.export.spice import SpiceNames
    from starcal_ros.products.calibration_json import read_calibration
    from starcal_ros.products.folder import calibration_file

    calibration = read_calibration(calibration_file(args.calibration))
    names = None
    if args.spacecraft_id is not None:
        names = SpiceNames(
            args.spacecraft_id,
            args.instrument_id,
            args.star_tracker_id,
            args.camera_frame,
            args.star_tracker_frame,
            args.pixel_size_um,
        )
    _make_folder(args.output)
    done = export(calibration, args.to, args.output, names, args.image_topic)
    print(f'written: {", ".join(map(str, done.files))}')
    if not math.isfinite(done.worst_px):
        print('the format cannot see the whole detector: use spice, opencv or csv')
    else:
        print(f'largest error of a pixel against the calibration: {done.worst_px:.3g} px')
    for loss in done.losses:
        print(f'left out: {loss.part}, {loss.cost_px:.3g} px alone')
    return 0


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f'{path}: cannot create the folder: {error.strerror}') from error


COMMANDS: Mapping[str, Callable[[argparse.Namespace], int]] = {'export': _export}
