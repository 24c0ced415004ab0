# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Contents of a bag and the images that a calibration would refuse, by the calibration's code."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from starcal_ground import campaign
from starcal_ground.bags import frames, reader
from starcal_ground.bags import topics as bag_topics
from starcal_ground.diagnosis import bags
from starcal_ground.diagnosis.bags import Refused
from starcal_ground.diagnosis.diagnose import Diagnosis
from starcal_ground.file_kinds import explained
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import BagError, OptionError
from starcal_ros.formats.messages import message_codec, sensor_messages
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import EnsembleStatus, StarObservations
from starcal_ros.sky.attitude import attitude_sample, AttitudeOptions

_STAMPED = (
    *message_codec.IMAGE_TYPES,
    message_codec.ATTITUDE_TYPE,
    message_codec.VELOCITY_TYPE,
    message_codec.TEMPERATURE_TYPE,
    message_codec.OBSERVATIONS_TYPE,
)


@dataclass(frozen=True)
class TopicContent:
    """
    Statistics of a topic.

    ``first_ns``, ``last_ns``, the median rate and the longest gap are of the stamps in the
    messages, or of the recording times for types that starcal does not read; with fewer than two
    messages the rate is 0.  ``kinds`` counts the images by encoding and size.  ``bad`` counts
    messages that cannot be decoded, and attitudes that are not rotations.
    """

    name: str
    type_name: str
    count: int
    rate_hz: float
    first_ns: int
    last_ns: int
    longest_gap_s: float
    backward: int
    kinds: Mapping[str, int]
    bad: int


@dataclass(frozen=True)
class Inspection:
    """
    Contents of a bag as a calibration reads it.

    ``chosen`` are the topics that it would read, None if they are ambiguous or missing, and
    ``images`` the number of its images.  ``longest_attitude_gap_s`` is between the attitude
    samples around an accepted image; NaN if none records it.  Only if the stars were ``measured``
    are there ``stars_per_image`` (accepted images), ``refused_stars`` (by reason) and the
    ``status`` of a calibration; if not, an image may still be refused for its stars.
    ``problems`` are why the bag cannot be calibrated, ``notes`` state the alignment that was found
    where none is given.  ``by_stars`` is True if the stars alone would give the camera.
    """

    bags: tuple[str, ...]
    topics: tuple[TopicContent, ...]
    chosen: bag_topics.Topics | None
    images: int
    refused: tuple[Refused, ...]
    longest_attitude_gap_s: float
    measured: bool
    stars_per_image: tuple[int, ...]
    refused_stars: Mapping[str, int]
    status: EnsembleStatus | None
    damage: tuple[str, ...]
    problems: tuple[str, ...]
    by_stars: bool
    notes: tuple[str, ...] = ()


def inspect(
    paths: Sequence[Path],
    given: bag_topics.Topics,
    setup: Setup | None = None,
    on_image: Callable[[], None] = lambda: None,
    through_air: campaign.ThroughAir | None = None,
    problem: str = '',
) -> Inspection:
    """
    Contents of bags and the images that a calibration would refuse.

    With a setup, stars are measured as for a calibration, which measures images that match no star
    once more in the end; ``through_air`` is that of `campaign.Source`.
    Without a setup, for which ``problem`` is the reason, images are only checked against the
    attitudes, at the default limits.  Raises BagError when a bag is missing or not a bag.
    """
    damage: dict[str, None] = {}  # an ordered set
    topics = _contents(paths, lambda text: damage.setdefault(text))
    options = setup.attitude if setup else AttitudeOptions()
    problems = [problem] if problem else []
    notes: tuple[str, ...] = ()
    by_stars, chosen = setup is not None and not setup.has_tracker, None
    seen: list[StarObservations] = []
    try:
        if setup is None and bag_topics.without_attitudes(paths, given, {}):
            by_stars, chosen = (
                True,
                bag_topics.Topics(image=bag_topics.choose_image_topic(paths, given)),
            )
        if setup:
            source = campaign.chosen(campaign.Source(tuple(paths), given, setup, through_air))
            chosen, setup, notes = source.topics, source.setup, source.notes
            records = bag_topics.read(paths, chosen, setup)
        elif (chosen := chosen or bag_topics.choose_topics(paths, given)).observations:
            records = reader.read_observations(paths, chosen.observations)
        else:
            records = bags.placed(paths, chosen, options)
        for observations in records:
            seen.append(observations)
            on_image()
        if through_air is not None:
            seen, note = through_air(seen)
            notes = (*notes, note) if note else notes
    except (BagError, OptionError) as error:
        problems.append(explained(error))
        problems = list(dict.fromkeys(problems))
    used = [observations for observations in seen if not observations.refusal]
    measured = setup is not None or bool(chosen and chosen.observations)
    status = None
    if setup and chosen:
        status = solve.ensemble_status(solve.ensemble_of(seen, setup), setup)
    if chosen and problems in ([], [problem]):
        problems += _shortages(used, status)
    if chosen and seen and not used:
        cause = cause_of(paths, chosen, setup, bags.refusals(seen), len(seen))
        problems += [cause.in_a_sentence('' if by_stars else 'starcal diagnose')] if cause else []
    return Inspection(
        bags=tuple(map(str, paths)),
        topics=topics,
        chosen=chosen,
        images=len(seen),
        refused=bags.refusals(seen),
        longest_attitude_gap_s=max(
            (o.attitude_gap_s for o in used if math.isfinite(o.attitude_gap_s)), default=math.nan
        ),
        measured=measured,
        stars_per_image=tuple(len(o) for o in used) if measured else (),
        refused_stars=dict(sum((Counter(o.refused_stars) for o in used), Counter())),
        status=status,
        damage=tuple(damage),
        problems=tuple(problems),
        by_stars=by_stars,
        notes=notes,
    )


def _contents(paths: Sequence[Path], on_damage: reader.Damage) -> tuple[TopicContent, ...]:
    """Statistics of every topic, sorted by name and type, from one pass over the files."""
    stamps: defaultdict[tuple[str, str], list[int]] = defaultdict(list)
    kinds: defaultdict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    bad: Counter[tuple[str, str]] = Counter()
    for raw in frames.read_ahead(reader.read_raw(paths, on_damage=on_damage)):
        topic, stamp_ns = (raw.topic, raw.type_name), raw.log_time_ns
        if raw.type_name in _STAMPED:
            try:
                message = reader.decode(raw)
            except BagError:
                bad[topic] += 1
            else:
                stamp_ns = message_codec.stamp_ns(message.header.stamp)
                if raw.type_name in message_codec.IMAGE_TYPES:
                    kinds[topic][_kind(message)] += 1
                elif raw.type_name == message_codec.ATTITUDE_TYPE:
                    sample = attitude_sample(*sensor_messages.attitude_from_message(message), '')
                    bad[topic] += sample is None
        stamps[topic].append(stamp_ns)
    contents = []
    for topic, there_ns in sorted(stamps.items()):
        steps_s = np.diff(sorted(there_ns)) / NANOSECONDS_PER_SECOND
        middle_s = float(np.median(steps_s)) if steps_s.size else 0.0
        contents.append(
            TopicContent(
                *topic,
                count=len(there_ns),
                rate_hz=1.0 / middle_s if middle_s > 0 else 0.0,
                first_ns=min(there_ns),
                last_ns=max(there_ns),
                longest_gap_s=float(steps_s.max(initial=0.0)),
                backward=int((np.diff(there_ns) < 0).sum()),
                kinds=dict(kinds[topic]),
                bad=bad[topic],
            )
        )
    return tuple(contents)


def _kind(message: message_codec.Message) -> str:
    """Encoding and size of an image message as text."""
    if hasattr(message, 'encoding'):
        return f'{message.encoding} {message.width} x {message.height}'
    content = bytes(message.data)
    png = sensor_messages.png_header(content)
    header = png or sensor_messages.jpeg_header(content)
    if header is None:
        return f'{message.format or "compressed"}, not a PNG or JPEG'
    return f'{"PNG" if png else "JPEG"} {header.width} x {header.height}'


def cause_of(
    paths: Sequence[Path],
    requested: bag_topics.Topics,
    setup: Setup | None,
    refused: Sequence[Refused],
    images: int,
) -> Diagnosis | None:
    """The cause for which images are refused, by a diagnosis where all are; None if none shows."""
    if setup is None or not requested.image or sum(group.count for group in refused) < images:
        return bags.of_refusals(refused, images)
    try:
        diagnosis = bags.diagnose_bags(paths, requested, setup, refused)
    except BagError:
        return None
    return None if diagnosis.cause == 'none' else diagnosis


def _shortages(used: Sequence[StarObservations], status: EnsembleStatus | None) -> list[str]:
    """Reasons why a calibration is not possible."""
    if not used:
        return ['no usable image']
    if status is None:
        return []
    counts = (
        ('images', status.images, status.min_images),
        ('stars', status.stars, status.min_stars),
    )
    return [
        f'only {there} usable {what}, {wanted} needed (min_{what})'
        for what, there, wanted in counts
        if there < wanted
    ]
