# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Selection of the images of a bag by --from, --to, --first and --every."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from datetime import datetime, timezone
import math

from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text


@dataclass(frozen=True)
class Time:
    """Value of a time option: ``seconds`` since 1970 UTC, or since the first image of the bag."""

    seconds: float
    since_first_image: bool


@dataclass
class Selection:
    """
    Selection of images, queried in the order of the bag.

    It takes every ``every``-th image between the times ``start`` and ``end``, both included, and
    stops after ``first`` images.
    """

    start: Time | None = None
    end: Time | None = None
    first: int | None = None
    every: int = 1
    _first_ns: int | None = None
    _last_ns: int = 0
    _between: int = 0
    _taken: int = 0
    _answers: dict[int, bool] = field(default_factory=dict)

    def __call__(self, time_ns: int) -> bool:
        """True if the image of a stamp is taken."""
        if time_ns not in self._answers:  # a repeated query gets the same answer
            self._answers[time_ns] = self._takes(time_ns)
        return self._answers[time_ns]

    def _takes(self, time_ns: int) -> bool:
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last_ns = max(self._last_ns, time_ns)
        if self.start is not None and time_ns < self._ns(self.start):
            return False
        if self.end is not None and time_ns > self._ns(self.end):
            return False
        self._between += 1
        if (self._between - 1) % self.every:
            return False
        self._taken += 1
        return self.first is None or self._taken <= self.first

    def without_images(self) -> str:
        """Error message for a selection without images."""
        if self._first_ns is None:
            return '--from, --to, --every: the bag has no images'
        first, last = (utc_text(time_ns) for time_ns in (self._first_ns, self._last_ns))
        return (
            f'--from, --to: no image is between these times: the images span {first} to {last},'
            f' +0 to +{(self._last_ns - self._first_ns) / NANOSECONDS_PER_SECOND:g} s'
        )

    def _ns(self, time: Time) -> int:
        origin_ns = (self._first_ns or 0) if time.since_first_image else 0
        return origin_ns + round(time.seconds * NANOSECONDS_PER_SECOND)


def parse_time(text: str) -> Time:
    """
    A time as it is typed: UTC in ISO 8601, seconds since 1970, or +seconds since the first image.

    Raises argparse.ArgumentTypeError for another text.
    """
    try:
        seconds = float(text)
    except ValueError:
        try:
            read = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f'{text!r} is not a time: give 2026-05-15T07:20:00, seconds since 1970, or'
                ' +seconds after the first image'
            ) from error
        with_zone = read if read.tzinfo else read.replace(tzinfo=timezone.utc)
        return Time(with_zone.timestamp(), False)
    if not math.isfinite(seconds):
        raise argparse.ArgumentTypeError(f'{text!r} is not a finite number of seconds')
    return Time(seconds, text.strip().startswith('+'))


def selection(
    start: Time | None, end: Time | None, first: int | None, every: int | None
) -> Selection | None:
    """Selection by the options; None if they select all images."""
    if not (start or end or first or every):
        return None
    return Selection(start, end, first, every or 1)
