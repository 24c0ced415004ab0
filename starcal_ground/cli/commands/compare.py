# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Compare two calibrations in pixels and sigmas.

A and B are calibration.json files or folders with one; B may be the truth of a simulated bag.
Lines of sight are compared in the star tracker frame, before and after removing their common
rotation. Differences are B minus A; their sigmas assume that A and B are independent.

  # two runs
  starcal compare out again
  # with the truth of a simulated bag
  starcal compare out sim/truth.json
  # machine-readable output
  starcal compare out/calibration.json again/calibration.json --json
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ros import text
from starcal_ros.constants import ARCSECOND_RAD

if TYPE_CHECKING:
    from starcal_ground.comparison import Comparison, DifferenceMap


def add_arguments(command: argparse.ArgumentParser) -> None:
    for name, which in (('a', 'reference calibration'), ('b', 'calibration to compare')):
        what = f'{which}: calibration.json or its folder'
        command.add_argument(name, type=arguments.path, metavar=name.upper(), help=what)
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground import comparison
    from starcal_ground.products import read_residuals, RESIDUALS_FILE
    from starcal_ground.simulation.simulated_bag import read_truth
    from starcal_ros.formats.products.product_files import (
        CALIBRATION_FILE,
        calibration_file,
        read_calibration,
    )

    of_a, of_b = (calibration_file(path) for path in (args.a, args.b))
    a = read_calibration(of_a)
    b = read_truth(of_b, a) or read_calibration(of_b)
    products = (path for path in (of_a, of_b) if path.name == CALIBRATION_FILE)
    beside = (path.with_name(RESIDUALS_FILE) for path in products)
    stamps_ns = [read_residuals(path).image_time_ns for path in beside if path.is_file()]
    result = comparison.compare(a, b, stamps_ns)
    if args.json:
        arguments.print_json(comparison.content(result))
    else:
        print_comparison(result)
    return arguments.EXIT_ACCEPTED


def print_comparison(comparison: Comparison) -> None:
    """Print the differences of parameters, alignment and lines of sight."""
    a, b = (c.geometry.camera for c in (comparison.a, comparison.b))
    difference, sigma = comparison.difference, comparison.sigma
    rows = [
        (
            name,
            text.to_sigma(a.parameters[k], sigma[k]),
            text.to_sigma(b.parameters[k], sigma[k]),
            text.to_sigma(difference[k], sigma[k], '+'),
            text.significant(sigma[k], 2) if sigma[k] else 'held',
            _sigmas(difference[k], sigma[k]),
        )
        for k, name in enumerate(b.parameter_names)
        if difference.size
    ]
    arcsec, sigma_arcsec = difference[-3:] / ARCSECOND_RAD, sigma[-3:] / ARCSECOND_RAD
    rows += [
        (f'alignment {axis}', '', '', f'{d:+.2f}″', f'{s:.2f}″', _sigmas(d, s))
        for axis, d, s in zip('xyz'[: len(arcsec)], arcsec, sigma_arcsec, strict=True)
        if comparison.is_aligned
    ]
    if rows:
        terminal.print_table(('parameter', 'A', 'B', 'B - A', '1-sigma', 'in sigmas'), rows)
    terminal.print_table(
        ('lines of sight', 'worst', 'rms', 'worst', 'rms'),
        [
            *[('as calibrated', *_map_cells(comparison.before))] * comparison.is_aligned,
            ('common rotation removed', *_map_cells(comparison.after)),
        ],
    )
    if comparison.is_aligned:
        terminal.print_text(f'common rotation {comparison.rotation_rad / ARCSECOND_RAD:.2f}″')
    else:
        terminal.print_text('alignment: not in both, so the cameras alone are compared')
    total = comparison.total
    if total.degrees_of_freedom:
        terminal.print_text(
            f'all parameters  chi2 {total.value:.1f}, {total.degrees_of_freedom} degrees of '
            f'freedom, p-value {text.p_value_text(total.p_value)}'
        )
    for note in comparison.notes:
        terminal.print_text(f'note: {note}')


def _map_cells(difference: DifferenceMap) -> Sequence[str]:
    cells = [f'{px:.4f} px' for px in difference.worst_and_rms_px]
    sigmas = difference.worst_and_rms_sigmas
    return cells + [f'{one:.2f} sigma' if one == one else '' for one in sigmas]


def _sigmas(difference: float, sigma: float) -> str:
    return f'{difference / sigma:+.1f}' if sigma > 0 else ''
