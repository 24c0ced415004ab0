# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Play a bag on the ROS graph.

Publishes the messages of a bag with their own stamps, for the nodes to calibrate from.

  # in real time
  starcal play bags/tiny
  # as fast as the stars are observed
  starcal play bags/tiny --rate 0
  # on another topic
  starcal play bags/tiny --remap /opnav/image_raw:=/camera/image_raw
"""

import argparse

from starcal_ground.cli import arguments, node_processes


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument('bag', type=arguments.path, metavar='BAG', help=arguments.BAGS)
    what = 'playback speed; 1 is real time, 0 is as fast as stars are observed (default: 1)'
    rate = arguments.number(float, 0, 1e6)
    command.add_argument('--rate', type=rate, default=1.0, metavar='R', help=what)
    arguments.add_remaps(command, 'publish topic A of the bag as B; may be repeated')


def run(args: argparse.Namespace) -> int:
    from starcal_ground.bags import reader

    reader.mcap_files([args.bag])
    parameters = node_processes.player_arguments(args.bag, args.rate)
    return node_processes.become('bag_player', parameters, args.remap)
