# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
List the contents of a bag, and find out why its images match no star.

Lists topics, rates, stamps and sizes, and measures each image as starcal calibrate does.  Then
identifies some of the first images without attitude or alignment, compares the attitudes,
alignment and camera that are stated with them, and prints the error, the evidence for it and the
lines of the parameter file that correct it, or why starcal calibrate refuses images that fit.

  # nothing is stated: the camera is found by the stars
  starcal diagnose bags/tiny
  # find the cause if no image matches
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 the set-up is right and starcal calibrate accepts the images; 3 it does not, or the
set-up is wrong, or the cause is unknown; 2 bad input.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import functools
import math
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ros.constants import utc_text
from starcal_ros.errors import BagError, NotFromStars, OptionError
from starcal_ros.text import counted, significant

if TYPE_CHECKING:
    from starcal_ground.bags.contents import TopicContent
    from starcal_ground.source_diagnosis import Contents


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_inputs(command)
    arguments.add_json(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.images.first_setup import source_of
    from starcal_ground.source_diagnosis import examine, without_setup

    given = arguments.given(args)
    _ = given.checked  # a bad option is bad input; a set-up that is not found is diagnosed
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        try:
            source = source_of(given, Path(name), Path(name), arguments.print_notes)
        except (NotFromStars, OptionError, BagError) as error:
            if given.photographs:
                raise
            examined = without_setup(given.paths, given.topics, error)
        else:
            arguments.print_notes(source.notes)
            progress = functools.partial(terminal.progress_bar, label='images')
            examined = examine(source, progress)
    arguments.print_notes(examined.notes)
    contents, diagnosis = examined.contents, examined.diagnosis
    accepted = diagnosis.cause == 'none'
    if args.json:
        arguments.print_json({**vars(diagnosis), 'contents': contents})
    else:
        _print_contents(contents)
        terminal.print_text()
        terminal.print_verdict(accepted, diagnosis.sentence)
        for title, lines in (
            ('evidence', diagnosis.evidence),
            ('in the parameter file', diagnosis.mend),
        ):
            if lines:
                terminal.print_text('\n  '.join([f'\n{title}:', *lines]))
    return arguments.EXIT_ACCEPTED if accepted else arguments.EXIT_REFUSED


def _print_contents(contents: Contents) -> None:
    """Print topics, images, attitudes and refused images."""
    for topic in contents.topics:
        terminal.print_wrapped(f'{topic.name}: {"; ".join(_topic_notes(topic))}')
    for text in contents.damage:
        terminal.print_text(f'damage: {text}')
    for text in _image_notes(contents):
        terminal.print_wrapped(text)


def _topic_notes(topic: TopicContent) -> Iterator[str]:
    yield topic.type_name.replace('/msg/', '/')
    rate = f' at {significant(topic.rate_hz, 3)} Hz' if topic.rate_hz else ''
    yield f'{counted(topic.count, "message")}{rate}'
    first, last = utc_text(topic.first_ns), utc_text(topic.last_ns)
    same_day = first.partition(' ')[0] == last.partition(' ')[0]
    yield f'{first} to {_clock(topic.last_ns) if same_day else last}'
    if topic.count > 1:
        yield f'longest gap {significant(topic.longest_gap_s, 3)} s'
    yield from (f'{count} x {kind}' for kind, count in topic.kinds.items())
    if topic.bad:
        yield f'{topic.bad} of {topic.count} messages are invalid'
    if topic.backward:
        yield f'stamps go back {topic.backward} times'


def _image_notes(contents: Contents) -> Iterator[str]:
    from starcal_ground.products import reasons_in_words

    count, chosen = contents.looked_at, contents.chosen
    if not (count and chosen):
        return
    used = count - sum(group.count for group in contents.refused)
    of = 'of' if count == contents.images else f'of the first {count} of'
    attitudes = ', '.join(filter(None, (chosen.attitude, *chosen.more_attitudes)))
    yield (
        f'{used} {of} {counted(contents.images, "image")} of {chosen.image or chosen.observations}'
        f' can be used' + (f', with the attitudes of {attitudes}' if attitudes else '')
    )
    if math.isfinite(contents.longest_attitude_gap_s):
        gap_s = significant(contents.longest_attitude_gap_s, 3)
        yield f'longest attitude gap around an image: {gap_s} s'
    for group in contents.refused:
        first = f'first {_clock(group.first_ns)}: {group.detail}'
        yield f'{group.count} refused as {group.reason}: {group.meaning}; {first}'
    if stars := contents.stars_per_image:
        yield (
            f'stars per image: {min(stars)} to {max(stars)}, {sum(stars)} in total; '
            f'refused: {reasons_in_words(contents.refused_stars)}'
        )


def _clock(time_ns: int) -> str:
    return utc_text(time_ns).partition(' ')[2]
