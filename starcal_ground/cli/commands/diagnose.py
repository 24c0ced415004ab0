# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Find out why the images of a bag match no star.

Identifies some of the first images without attitude or alignment, compares the attitudes,
alignment and camera that are stated with them, and prints the error, the evidence for it and the
lines of the parameter file that correct it.  Where all of them fit, it measures up to 40 images as
starcal calibrate does, and prints why that would refuse them.

  # find the cause if no image matches
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 the set-up is right and starcal calibrate accepts the images; 3 it does not, or the
set-up is wrong, or the cause is unknown; 2 bad input.
"""

import argparse
from pathlib import Path
import tempfile

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_inputs(command)
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.images.first_setup import first_setup
    from starcal_ground.source_diagnosis import diagnose_source

    given = arguments.given(args)
    setup, _ = given.checked()
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        first = first_setup(given, setup, Path(name), Path(name), arguments.print_notes)
        source = first.source
        arguments.print_notes(source.notes)
        diagnosis = diagnose_source(source)
    if args.json:
        arguments.print_json(diagnosis)
    else:
        lines = [diagnosis.sentence, '', 'evidence:', *(f'  {x}' for x in diagnosis.evidence)]
        if diagnosis.mend:
            lines += ['', 'in the parameter file:', *(f'  {x}' for x in diagnosis.mend)]
        terminal.print_text('\n'.join(lines))
    return arguments.EXIT_ACCEPTED if diagnosis.cause == 'none' else arguments.EXIT_REFUSED
