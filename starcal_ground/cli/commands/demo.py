# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrate a small bag with the real ROS nodes.

Starts the nodes, plays ten simulated images to them, requests a calibration through the service
and prints the result and the truth.

  # write to the folder starcal_demo
  starcal demo
  # write to another folder
  starcal demo -o first_look
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal

if TYPE_CHECKING:
    from starcal_ros.records import CameraGeometry

_MOST_SIGMAS = 5.0  # exceeded by one random demo in 10^5; with the fixed seed by none


def add_arguments(command: argparse.ArgumentParser) -> None:
    what = 'folder for products and log files, created if absent (default: starcal_demo)'
    arguments.add_output(command, 'DIR', what, default=Path('starcal_demo'))


def run(args: argparse.Namespace) -> int:
    from starcal_ground.cli import node_processes

    node_processes.check_ros()  # before modules whose packages a vehicle lacks

    import numpy as np

    from starcal_ground import comparison, products
    from starcal_ground.bags.topics import Topics
    from starcal_ground.campaign import chosen, Source
    from starcal_ground.cli.commands.compare import print_comparison
    from starcal_ground.cli.into_folder import calibrate_into, check_folder, Drawings
    from starcal_ground.report import page
    from starcal_ros.pipeline.setup import load_setup

    products.make_folder(args.output)
    bag = tiny_bag(args.output)
    check_folder(args.output, [bag.bag], ())
    products.check_outputs(node_processes.outputs(args.output))
    terminal.print_text(f'bag {bag.bag}; log files and products in {args.output}')
    with terminal.progress_bar(bag.image_count, 'images') as advance:
        calibration, verdict = node_processes.calibrate_with_nodes(
            bag.bag, bag.parameters, bag.image_count, args.output, advance
        )
    terminal.print_text(verdict)
    if calibration is None:
        return arguments.EXIT_REFUSED
    truth = comparison.truth_like(calibration, bag.truth)
    of_truth = comparison.compare(calibration, truth)
    print_comparison(of_truth)
    worst_sigmas = float(np.nanmax(np.abs(of_truth.sigmas)))
    good = worst_sigmas <= _MOST_SIGMAS
    terminal.print_verdict(
        good,
        f'largest error {worst_sigmas:.1f} sigma, '
        f'{"within" if good else "over"} the limit of {_MOST_SIGMAS:g} sigma',
    )
    # The nodes publish no residuals: they are those of the tool, which calibrates the bag alike.
    source = chosen(Source((bag.bag,), Topics(), load_setup(bag.parameters)))
    calibrate_into(args.output, source, dict)
    products.write_products(calibration, args.output)
    with Drawings().kind('report'):
        terminal.print_text(f'open {page.write_report(args.output)}')
    return arguments.EXIT_ACCEPTED if good else arguments.EXIT_REFUSED


@dataclass(frozen=True)
class DemoBag:
    """A bag folder with its parameters and the true geometry."""

    bag: Path
    parameters: dict[str, object]
    truth: CameraGeometry
    image_count: int


def tiny_bag(spare: Path) -> DemoBag:
    """The small bag of the source tree or the installed package, or one rendered under `spare`."""
    import yaml

    from starcal_ground.simulation import scenario, simulated_bag

    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    places = [Path(__file__).parents[3], *(Path(p, 'share/starcal') for p in prefixes if p)]
    folders = (place / 'bags' / 'tiny' for place in places)
    folder = next((f for f in folders if (f / 'truth.json').is_file()), None)
    if folder is None:
        folder = simulated_bag.write_bag(scenario.scenario('tiny'), spare / 'tiny').bag
    truth = json.loads((folder / 'truth.json').read_text())
    parameters = yaml.safe_load((folder / 'params.yaml').read_text())['/**']['ros__parameters']
    # The nodes may run in another folder: they need the absolute URL.
    parameters['camera_info_url'] = f'file://{(folder / "camera.yaml").resolve()}'
    return DemoBag(folder, parameters, simulated_bag.true_geometry(truth), truth['images'])
