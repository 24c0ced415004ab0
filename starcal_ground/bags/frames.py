# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images of bags, each with the telemetry of its time, from one pass over the files.

Another thread reads and decompresses while the images before are measured.  An image waits until
an attitude two seconds after it has been read: its rate takes those of the first of them.  Where
that is not enough - telemetry recorded in another file, far out of order or not at all - a second
pass reads all telemetry first, so that the order of recording changes no result.  Of images that
are not in the order of their stamps, the rest is sorted (`reader.by_stamp`).
"""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
import math
import operator
from pathlib import Path

import numpy as np

from starcal_ground.bags import reader
from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import BagError, ImageRefused
from starcal_ros.formats.messages import message_codec, sensor_messages
from starcal_ros.records import Image, StarObservations
from starcal_ros.sky.attitude import ARC_S, attitude_sample, AttitudeHistory, AttitudeOptions
from starcal_ros.text import counted

_LATE_NS = NANOSECONDS_PER_SECOND  # a sample is recorded at most so long after later ones
_ARC_NS = round(ARC_S * NANOSECONDS_PER_SECOND)
_WAITING_BYTES = 64 << 20  # images that wait for telemetry; two may always wait
_BATCH_BYTES = 8 << 20  # read ahead: an image, or the telemetry of an hour

_stamp_ns = operator.itemgetter(0)


@dataclass(frozen=True)
class Frame:
    """
    An image with its telemetry; velocity None and temperature NaN where there is none.

    ``attitudes`` holds all samples near the image; later frames share it.
    """

    image: Image
    attitudes: AttitudeHistory
    velocity_m_s: Floats | None
    temperature_degc: float
    more_attitudes: tuple[AttitudeHistory, ...] = ()


class Telemetry:
    """Samples of attitude, velocity (m/s) and temperature (degrees Celsius), each by time."""

    def __init__(
        self,
        topics: reader.Topics,
        options: AttitudeOptions,
        on_damage: reader.Damage = reader.log_damage,
    ) -> None:
        self.attitudes = AttitudeHistory()
        self.more_attitudes = tuple(AttitudeHistory() for _ in topics.more_attitudes)
        self.velocities: list[tuple[int, Floats]] = []
        self.temperatures: list[tuple[int, float]] = []
        self._topics = topics
        self._options = options
        self._on_damage = on_damage
        self._newest_ns: dict[str, int] = {}
        self.velocities_left_out = 0  # not plausible; the first is reported

    def add(self, raw: reader.RecordedMessage) -> bool:
        """Add a message, or report damage; False if it is out of order."""
        try:
            message = reader.decode(raw)
        except BagError as error:
            self._on_damage(str(error))
            return True
        by_topic = {
            self._topics.attitude: self.attitudes,
            **dict(zip(self._topics.more_attitudes, self.more_attitudes, strict=True)),
        }
        if raw.type_name in message_codec.ATTITUDE_TYPES:
            time_ns, quaternion = sensor_messages.attitude_from_message(message)
            sample = attitude_sample(time_ns, quaternion, self._options.attitude_direction)
            by_topic[raw.topic].add(time_ns, sample)
        elif raw.type_name == message_codec.VELOCITY_TYPE:
            try:
                time_ns, velocity_m_s = sensor_messages.velocity_from_message(message)
            except ValueError as error:
                self.velocities_left_out += 1
                if self.velocities_left_out == 1:
                    self._on_damage(f'{raw.topic}: {error}, as others like it')
                return True
            bisect.insort(self.velocities, (time_ns, velocity_m_s), key=_stamp_ns)
        else:
            time_ns, temperature_degc = sensor_messages.temperature_from_message(message)
            bisect.insort(self.temperatures, (time_ns, temperature_degc), key=_stamp_ns)
        newest_ns = self._newest_ns.setdefault(raw.topic, time_ns)
        self._newest_ns[raw.topic] = max(newest_ns, time_ns)
        # Topics one after another are out of order too: `covers` has seen one velocity at most.
        return time_ns >= max(newest_ns, max(self._newest_ns.values()) - _LATE_NS)

    def covers(self, time_ns: int) -> bool:
        """True if no further sample changes the telemetry of a time, but for very late ones."""
        newest_ns = self._newest_ns.get(self._topics.attitude)
        if newest_ns is None or newest_ns < time_ns + _ARC_NS + _LATE_NS:
            return False
        for topic, samples in (
            (self._topics.velocity, self.velocities),
            (self._topics.temperature, self.temperatures),
        ):
            if topic and not (samples and samples[0][0] <= time_ns):
                return False
        try:
            self.attitudes.around(time_ns, self._options.max_attitude_gap_s)
        except ImageRefused:
            return False
        return True

    def at(self, time_ns: int) -> tuple[Floats | None, float]:
        """Velocity and temperature at a time."""
        velocity_m_s = sensor_messages.latest_at(self.velocities, time_ns, None)
        return velocity_m_s, sensor_messages.latest_at(self.temperatures, time_ns, math.nan)

    def numbers_at(self, time_ns: int) -> Floats:
        """All that a measurement takes from the samples, (17,); NaN where there is none."""
        try:
            samples = self.attitudes.around(time_ns, self._options.max_attitude_gap_s)
            attitudes = [
                np.r_[sample.icrf_from_star_tracker_xyzw, sample.time_ns - time_ns]
                for sample in samples
            ]
        except ImageRefused:
            attitudes = [np.full(10, np.nan)]
        max_gap_s = self._options.max_attitude_gap_s
        rate_rad_s, _ = self.attitudes.rate_at(time_ns, max_gap_s, np.zeros(3))
        velocity_m_s, temperature_degc = self.at(time_ns)
        velocity_m_s = np.full(3, np.nan) if velocity_m_s is None else velocity_m_s
        return np.concatenate([*attitudes, velocity_m_s, [temperature_degc], rate_rad_s])


def read_telemetry(
    paths: Iterable[Path | str],
    topics: reader.Topics,
    options: AttitudeOptions | None = None,
    on_damage: reader.Damage = reader.log_damage,
) -> Telemetry:
    """All telemetry of bags; attitudes that are not unit quaternions count as invalid."""
    telemetry = Telemetry(topics, options or AttitudeOptions(), on_damage)
    for raw in reader.read_raw(paths, topics.telemetry, on_damage):
        telemetry.add(raw)
    return telemetry


def read_frames(
    paths: Sequence[Path | str],
    topics: reader.Topics,
    options: AttitudeOptions | None = None,
    on_damage: reader.Damage = reader.log_damage,
    size: tuple[int, int] | None = None,
    channel: str = '',
) -> Iterator[Frame | StarObservations]:
    """
    Images of bags with their telemetry, sorted by their stamps.

    They are in file order until a stamp goes back; the others follow sorted.  An image that cannot
    be decoded, or a compressed one of another ``size`` (width, height), becomes refused
    observations; ``channel`` is the colour that is taken of colour images (`image_from_message`).
    The first sample out of order starts the second pass; images yielded before it whose telemetry
    that pass changes are reported to ``on_damage``.
    """
    options = options or AttitudeOptions()
    # Which of several star trackers an image takes depends on all that are there.
    is_complete = any(topics.more_attitudes)
    telemetry = (
        read_telemetry(paths, topics, options, on_damage)
        if is_complete
        else Telemetry(topics, options, on_damage)
    )
    waiting: deque[Image | StarObservations] = deque()
    taken: list[tuple[int, Floats]] = []
    count, newest_ns, goes_back = 0, 0, False
    for raw in read_ahead(reader.read_raw(paths, topics.read, on_damage)):
        in_order = True
        if raw.type_name in message_codec.IMAGE_TYPES:
            stamp_ns = reader.image_stamp_ns(raw)
            goes_back = stamp_ns < newest_ns and raw.place is not None
            if goes_back:
                break
            count, newest_ns = count + 1, stamp_ns
            waiting.append(sensor_messages.image_of(raw, options.stamp_offset_s, size, channel))
        elif not is_complete:
            in_order = telemetry.add(raw)
        if not is_complete and (not in_order or _is_too_much(waiting)):
            telemetry, is_complete = read_telemetry(paths, topics, options, on_damage), True
            _report_changed(taken, telemetry, on_damage)
        while waiting and (is_complete or _is_ready(waiting[0], telemetry)):
            if not is_complete and isinstance(waiting[0], Image):
                taken.append((waiting[0].time_ns, telemetry.numbers_at(waiting[0].time_ns)))
            yield _with_telemetry(waiting.popleft(), telemetry)
    if goes_back and not is_complete:
        telemetry = read_telemetry(paths, topics, options, on_damage)
        _report_changed(taken, telemetry, on_damage)
    while waiting:
        yield _with_telemetry(waiting.popleft(), telemetry)
    if goes_back:
        for raw in read_ahead(reader.by_stamp(paths, topics.read - topics.telemetry, count)):
            image = sensor_messages.image_of(raw, options.stamp_offset_s, size, channel)
            yield _with_telemetry(image, telemetry)


def _is_too_much(waiting: Iterable[Image | StarObservations]) -> bool:
    sizes = [item.pixels.nbytes for item in waiting if isinstance(item, Image)]
    return len(sizes) > 2 and sum(sizes) > _WAITING_BYTES


def _is_ready(item: Image | StarObservations, telemetry: Telemetry) -> bool:
    return isinstance(item, StarObservations) or telemetry.covers(item.time_ns)


def _with_telemetry(
    item: Image | StarObservations, telemetry: Telemetry
) -> Frame | StarObservations:
    if isinstance(item, StarObservations):
        return item
    return Frame(item, telemetry.attitudes, *telemetry.at(item.time_ns), telemetry.more_attitudes)


def _report_changed(
    taken: Iterable[tuple[int, Floats]], telemetry: Telemetry, on_damage: reader.Damage
) -> None:
    """Report images whose telemetry, now that all is read, is not that they were given."""
    changed = sum(
        not np.array_equal(numbers, telemetry.numbers_at(time_ns), equal_nan=True)
        for time_ns, numbers in taken
    )
    if changed:
        on_damage(
            'telemetry is recorded more than a second out of order, after'
            f' {counted(changed, "image")} that it belongs to; sort the messages of the bag by'
            ' time'
        )


def read_ahead(messages: Iterator[reader.RecordedMessage]) -> Iterator[reader.RecordedMessage]:
    """The same messages, read by another thread while those before them are in use."""
    with ThreadPoolExecutor(1, 'read-ahead') as thread:
        pending = thread.submit(_batch, messages)
        while batch := pending.result():
            pending = thread.submit(_batch, messages)
            while batch:
                yield batch.popleft()


def _batch(messages: Iterator[reader.RecordedMessage]) -> deque[reader.RecordedMessage]:
    """The next messages, up to a size; none at the end."""
    batch: deque[reader.RecordedMessage] = deque()
    size = 0
    for raw in messages:
        batch.append(raw)
        size += len(raw.view)
        if size >= _BATCH_BYTES:
            break
    return batch
