# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records of a calibrator in memory joined with those of a state folder, so that none is lost.

Images are a set by stamp.  A collection of images begins with a folder, a move or a reset, and a
reset ends the collections before it, so that their images do not come back from another place.
Activations are sequences; each event has a unique origin, so that two places can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain
import secrets

import numpy as np

from starcal_ros.records import Activation, Ensemble, StarObservations
from starcal_ros.text import counted

HISTORY = 20  # activations kept for roll-back, under 1 MB each
# Resets that are remembered: a file of 20 kB.  An older reset matters only to a folder that was
# not opened since.
_ENDED = 1000


@dataclass(frozen=True)
class Collections:
    """Unique names of the collections that the images are of, and of those that a reset ended."""

    current: tuple[str, ...] = ()
    ended: tuple[str, ...] = ()

    def begun(self) -> Collections:
        """The same with a new collection, which the images to come are of."""
        return replace(self, current=(*self.current, secrets.token_hex(8)))

    def reset(self) -> Collections:
        """All collections ended, and a new one begun."""
        return Collections((), (*self.ended, *self.current)[-_ENDED:]).begun()

    def survives(self, other: Collections) -> bool:
        """True unless each collection was ended by a reset of the other place."""
        return not self.current or not set(self.current) <= set(other.ended)


@dataclass(frozen=True)
class Kept:
    """The records of a place: memory or a state folder."""

    ensemble: Ensemble = field(default_factory=Ensemble)
    history: tuple[Activation, ...] = ()
    collections: Collections = Collections()

    def __bool__(self) -> bool:
        """True if there is an image or an activation."""
        return bool(self.ensemble.images or self.history)

    def __str__(self) -> str:
        """Return the numbers of images and activations in words."""
        images = counted(len(self.ensemble.images), 'image')
        return f'{images} and {counted(len(self.history), "activation")}'


def joined(folder: Kept, memory: Kept, last_event: int) -> Kept:
    """
    The records of a folder and of the memory together; ``last_event`` as `Archive` has it.

    An image that a reset of the other place dropped is left out.
    """
    pairs = (folder, memory), (memory, folder)
    alive = [one for one, other in pairs if one.collections.survives(other.collections)]
    current = dict.fromkeys(name for one in alive for name in one.collections.current)
    ended = dict.fromkeys((*folder.collections.ended, *memory.collections.ended))
    return Kept(
        _joined_images(alive),
        _joined_history(folder.history, memory.history, last_event),
        Collections(tuple(current), tuple(ended)[-_ENDED:]),
    )


def _joined_images(places: Sequence[Kept]) -> Ensemble:
    """All images by stamp, those of the first place first; another of a stamp is a duplicate."""
    images: dict[int, StarObservations] = {}
    duplicates = 0
    for place in places:
        for image in place.ensemble.images:
            duplicates += not _is_same(images.setdefault(image.time_ns, image), image)
    # Counts of one collection only grow; those of two collections are of different images.
    names = [set(place.collections.current) for place in places]
    total = max if names and set.intersection(*names) else sum
    counts = [place.ensemble.refused for place in places]
    refused = {reason: total(one.get(reason, 0) for one in counts) for reason in chain(*counts)}
    if duplicates:
        refused['duplicate'] = refused.get('duplicate', 0) + duplicates
    return Ensemble(tuple(images.values()), refused)


def _is_same(one: StarObservations, other: StarObservations) -> bool:
    # Measured pixels are equal to the last bit only in one measurement of one image.  A record
    # that was read differs from the one written in fields that the message lacks.
    return np.array_equal(one.measured_px, other.measured_px) and np.array_equal(
        one.catalog_id, other.catalog_id
    )


def _joined_history(
    folder: tuple[Activation, ...], memory: tuple[Activation, ...], last_event: int
) -> tuple[Activation, ...]:
    """
    All events in order of time, the last of which is active.

    Events of the folder keep their numbers where the order allows it.  Others keep theirs where no
    file of the folder has had them, and get the next free ones elsewhere; so do calibrations.
    """
    written = {record.origin: record for record in folder}
    common = [(record, written[record.origin]) for record in memory if record.origin in written]
    numbers = {one.calibration.number: other.calibration.number for one, other in common}
    taken = {record.calibration.number for record in folder}
    origin_of = [{record.event: record.origin for record in place} for place in (memory, folder)]
    starts = {place[0].origin for place in (memory, folder) if place and not common}
    before_start = [0, 0]  # the event that the first one of memory, and of the folder, comes after
    events: dict[str, int] = {}
    result: list[Activation] = []
    for record in _in_order(folder, memory):
        is_written = record.origin in written
        floor = result[-1].event if result else 0
        if record.origin in starts:
            before_start[is_written] = floor
        free = max(last_event, floor) + 1
        is_kept = record.event > floor if is_written else record.event >= free
        event = events[record.origin] = record.event if is_kept else free
        number = record.calibration.number
        if not is_written:
            number = numbers.setdefault(number, event if number in taken else number)
            taken.add(number)
        # An event that is not on record in its place: its number may be that of another here.
        before = record.before if is_written else 0
        before = events.get(origin_of[is_written].get(record.before, ''), before)
        before = before or before_start[is_written]
        calibration = replace(record.calibration, number=number)
        result.append(replace(record, event=event, before=before, calibration=calibration))
    return tuple(result[-HISTORY:])


def _in_order(folder: Sequence[Activation], memory: Sequence[Activation]) -> list[Activation]:
    """
    Events of two sequences, each once, by time, those of memory last where times are equal.

    Each sequence keeps its order, also after its clock was set back.
    """
    placed: dict[str, tuple[int, Activation]] = {}
    for place in (folder, memory):
        times = (record.calibration.active_since_ns for record in place)
        for time_ns, record in zip(accumulate(times, max), place, strict=True):
            placed.setdefault(record.origin, (time_ns, record))
    return [record for _, record in sorted(placed.values(), key=lambda item: item[0])]
