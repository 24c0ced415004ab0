# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Find out why the images of a bag match no star.

Identifies some of the first images without attitude or alignment, compares the attitudes,
alignment and camera with them, and prints the error, the evidence for it and the lines of the
parameter file that correct it.

  # find the cause if no image matches
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 the set-up is right; 3 it is wrong, or the cause is unknown; 2 bad input.
"""

import argparse

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_bags(command)
    arguments.add_params(command)
    arguments.add_topics(command)
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ros.pipeline.diagnosis.bags import diagnose_bags
    from starcal_ros.pipeline.setup import read_setup

    diagnosis = diagnose_bags(args.bags, arguments.topics(args), read_setup(args.params))
    if args.json:
        arguments.print_json(diagnosis)
    else:
        terminal.print_text('\n'.join(diagnosis.in_lines()))
    return arguments.EXIT_ACCEPTED if diagnosis.cause == 'none' else arguments.EXIT_REFUSED
