# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Show running nodes in the terminal.

Shows images and refusals by reason, coverage, for each parameter the forecast sigma and that of
the active calibration, the gate and the health of the nodes.

  # live, until Ctrl-C
  starcal monitor
  # nodes in a namespace
  starcal monitor --remap __ns:=/cam1
  # one view after five seconds, for a log
  starcal monitor --once 5
"""

import argparse
import sys

from starcal_ground.cli import arguments, node_processes
from starcal_ros.errors import OptionError


def add_arguments(command: argparse.ArgumentParser) -> None:
    what = 'print one view after S seconds and end; needed where the output is not a terminal'
    once = arguments.number(float, 0, 3600)
    command.add_argument('--once', type=once, metavar='S', help=what)
    arguments.add_remaps(command, 'read topic A of the nodes from B; may be repeated')


def run(args: argparse.Namespace) -> int:
    if args.once is None and not sys.stdout.isatty():
        raise OptionError('--once: needed where the output is not a terminal, e.g. --once 5')
    once = [] if args.once is None else ['--once', repr(args.once)]
    return node_processes.become('starcal_ground.ros.monitor_client', once, args.remap)
