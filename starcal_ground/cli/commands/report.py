# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Rewrite report.html of a calibration.

Makes one page from the files of a folder: gate verdict, parameters, residuals, uncertainties,
refused images and stars. The page needs no network. A browser prints it as numbered pages with a
block for signatures.

  # from the files of an earlier calibration
  starcal report out
  # of the active calibration of a calibrator, from its state_dir
  starcal report state
"""

import argparse

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    what = 'folder with the products of starcal calibrate, or the state_dir of a calibrator'
    command.add_argument('folder', type=arguments.path, metavar='DIR', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.products import check_outputs, REPORT_FILE
    from starcal_ground.report import page

    check_outputs([args.folder / REPORT_FILE])
    terminal.print_text(f'report written to {page.write_report(args.folder)}')
    return arguments.EXIT_ACCEPTED
