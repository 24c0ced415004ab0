# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Topics of bags with their stamps, sizes of images and messages that cannot be read."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from starcal_ground.bags import frames, reader
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import BagError
from starcal_ros.formats.messages import message_codec, sensor_messages
from starcal_ros.sky.attitude import attitude_sample

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


def topic_contents(paths: Sequence[Path], on_damage: reader.Damage) -> tuple[TopicContent, ...]:
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
