# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
List the contents of a bag and the images a calibration would refuse.

Lists topics, rates, stamps, encodings and gaps, and measures each image as a calibration does,
with what is stated, found and assumed.

  # of which nothing is stated
  starcal inspect bags/tiny
  # with its parameter file
  starcal inspect bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal inspect bags/tiny --json

exit status: 0 the bag can be calibrated; 3 it cannot, with the reasons; 2 bad input.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
import math
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ros.constants import utc_text
from starcal_ros.errors import BagError, NotFromStars, OptionError
from starcal_ros.text import counted, significant

if TYPE_CHECKING:
    from starcal_ground.planning.inspect import Inspection, TopicContent


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_inputs(command)
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.bags import reader
    from starcal_ground.file_kinds import explained
    from starcal_ground.images.first_setup import first_setup
    from starcal_ground.planning import inspect
    from starcal_ros.formats.messages import message_codec

    kinds = (*message_codec.IMAGE_TYPES, message_codec.OBSERVATIONS_TYPE)
    given = arguments.given(args)
    bags, topics, (setup, _) = tuple(given.paths), given.topics, given.checked()
    through_air, problem = None, ''
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        try:
            first = first_setup(given, setup, Path(name), Path(name), arguments.print_notes)
        except (NotFromStars, OptionError, BagError) as error:
            if given.photographs:
                raise
            problem = explained(error)  # the bag is listed all the same
        else:
            source = first.source
            arguments.print_notes(source.notes)
            bags, topics, setup = source.bags, source.topics, source.setup
            through_air = source.through_air
        total = max((t.count for t in reader.topics(bags) if t.type_name in kinds), default=0)
        with terminal.progress_bar(total, 'images') as advance:
            inspection = inspect.inspect(bags, topics, setup, advance, through_air, problem)
    arguments.print_notes(inspection.notes)
    if args.json:
        arguments.print_json(inspection)
    else:
        _print(inspection)
    return arguments.EXIT_REFUSED if inspection.problems else arguments.EXIT_ACCEPTED


def _print(inspection: Inspection) -> None:
    """Print topics, images, attitudes and refused images."""
    from starcal_ground.report import verdict
    from starcal_ros.records import ALIGNMENT_NAMES

    terminal.print_table(
        ('topic', 'type', 'messages', 'rate', 'longest gap'),
        [
            (
                topic.name,
                topic.type_name.replace('/msg/', '/'),
                str(topic.count),
                f'{significant(topic.rate_hz, 3)} Hz' if topic.rate_hz else '',
                f'{significant(topic.longest_gap_s, 3)} s' if topic.count > 1 else '',
            )
            for topic in inspection.topics
        ],
        left=2,
    )
    for topic in inspection.topics:
        terminal.print_wrapped(f'{topic.name}: {"; ".join(_topic_notes(topic))}')
    for text in inspection.damage:
        terminal.print_text(f'damage: {text}')
    if inspection.images:
        _print_images(inspection)
    if inspection.status is not None:
        terminal.print_table(
            ('predicted', '1-sigma'),
            [
                (name, verdict.sigma_text(name, value))
                for name, value in zip(
                    inspection.status.parameter_names,
                    inspection.status.predicted_sigma,
                    strict=True,
                )
                if not (inspection.by_stars and name in ALIGNMENT_NAMES)
            ],
        )
    if inspection.problems:
        terminal.print_verdict(False, 'cannot be calibrated: ' + '; '.join(inspection.problems))
    elif inspection.by_stars:
        terminal.print_verdict(True, 'can be calibrated: the camera alone, without attitudes')
    else:
        terminal.print_verdict(True, 'can be calibrated')


def _print_images(inspection: Inspection) -> None:
    bad = sum(refused.count for refused in inspection.refused)
    chosen = inspection.chosen
    assert chosen is not None  # images come from a chosen topic
    attitudes = ', '.join(filter(None, (chosen.attitude, *chosen.more_attitudes)))
    terminal.print_wrapped(
        f'{inspection.images - bad} of {counted(inspection.images, "image")} of '
        f'{chosen.image or chosen.observations} can be used'
        + (f', with the attitudes of {attitudes}' if attitudes else '')
    )
    if math.isfinite(inspection.longest_attitude_gap_s):
        gap_s = significant(inspection.longest_attitude_gap_s, 3)
        terminal.print_text(f'longest attitude gap around an image: {gap_s} s')
    for group in inspection.refused:
        first = f'first {_clock(group.first_ns)}: {group.detail}'
        terminal.print_wrapped(
            f'{group.count} refused as {group.reason}: {group.meaning}; {first}'
        )
    if inspection.stars_per_image:
        stars = inspection.stars_per_image
        terminal.print_wrapped(
            f'stars per image: {min(stars)} to {max(stars)}, {sum(stars)} in total; '
            f'refused: {_counted(inspection.refused_stars)}'
        )


def _counted(counts: Mapping[str, int]) -> str:
    return ', '.join(f'{count} {reason}' for reason, count in counts.items()) or 'none'


def _topic_notes(topic: TopicContent) -> list[str]:
    notes = [f'{utc_text(topic.first_ns)} to {_clock(topic.last_ns)}']
    if topic.kinds:
        notes.append(', '.join(f'{count} x {kind}' for kind, count in topic.kinds.items()))
    if topic.bad:
        notes.append(f'{topic.bad} of {topic.count} messages are invalid')
    if topic.backward:
        notes.append(f'stamps go back {topic.backward} times')
    return notes


def _clock(time_ns: int) -> str:
    return utc_text(time_ns).partition(' ')[2]
