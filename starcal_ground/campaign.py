# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The recipe from bags to a calibration, which every program that reads bags follows.

`chosen` chooses the topics and finds the alignment where no prior one is given, `observe`
measures the stars, and `calibrate` solves.  If it is accepted, images that matched no star are
measured again with that calibration, and all images if it only lacks stars; a second solution
includes what is found then.  The nodes take the same steps by `observe` and `solve`; of the images
that match no star they keep the last few only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_ground.bags import reader
from starcal_ground.bags import topics as bag_topics
from starcal_ground.bags.topics import OnImage, Topics, Wanted
from starcal_ground.residuals import Residuals, solve_with_residuals
from starcal_ros.assessment.requirements import REQUIREMENTS
from starcal_ros.errors import OptionError
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import check_site, Setup
from starcal_ros.records import Calibration, Ensemble, StarObservations
from starcal_ros.text import counted

if TYPE_CHECKING:
    from starcal_ground.diagnosis.diagnose import Diagnosis

_FOR_WANT_OF_STARS = {REQUIREMENTS, 'min_coverage'}  # checks that fail, of a sound calibration

ThroughAir = Callable[[Sequence[StarObservations]], tuple[list[StarObservations], str]]
"""Observations with the refraction that they show, and a sentence on it or an empty one."""
Progress = Callable[[int], contextlib.AbstractContextManager[Callable[[], None]]]
"""Shows the progress through a number of images by a function to call for each."""


@dataclass(frozen=True)
class Source:
    """
    Bags, topics and setup; once `chosen`, the topics that are read and an alignment.

    ``through_air`` is given where the air, if any, is to be found by the stars, in all images
    together; ``notes`` are sentences for the user; ``files`` are those that the user gave.
    """

    bags: tuple[Path, ...]
    topics: Topics
    setup: Setup
    through_air: ThroughAir | None = None
    notes: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()

    @property
    def image_count(self) -> int:
        """Number of images, or of recorded observations."""
        kinds = self.topics.read - self.topics.telemetry
        there = reader.topics(self.bags)
        return sum(topic.count for topic in there if (topic.name, topic.type_name) in kinds)


@dataclass(frozen=True)
class Observed:
    """
    A source with the observations of its images, refused ones too, and notes so far.

    ``measured`` are the observations before the air was found.
    """

    source: Source
    measured: Sequence[StarObservations]
    observations: tuple[StarObservations, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Campaign:
    """
    A calibration with its residuals and what it was made from.

    ``observations`` are of all images, with those that were measured again; ``ensemble`` has those
    that were used.  ``notes`` are sentences for the user, those of the source first.
    """

    setup: Setup
    observations: tuple[StarObservations, ...]
    ensemble: Ensemble
    calibration: Calibration
    residuals: Residuals
    notes: tuple[str, ...]


def looked_up(source: Source) -> tuple[Source, Diagnosis | None]:
    """
    A source with the topics to calibrate from, and an alignment if the images show it.

    The diagnosis of the images is given where the setup has no alignment; recorded observations
    need none, since their stars are identified.  Raises BagError when a bag cannot be read, a
    topic is missing or several have its type.  Raises OptionError for a camera on the ground of
    which neither the site is stated nor the air to be found.
    """
    if source.through_air is None:
        check_site(source.setup.site)
    topics = bag_topics.choose_topics(source.bags, source.topics, source.setup)
    if source.setup.is_aligned or topics.observations:
        return replace(source, topics=topics), None
    from starcal_ground.diagnosis.bags import aligned_by_stars  # seldom needed, slow

    setup, diagnosis = aligned_by_stars(source.bags, topics, source.setup)
    return replace(source, topics=topics, setup=setup), diagnosis


def chosen(source: Source) -> Source:
    """`looked_up`, with a note on an alignment that is found; raises OptionError if it is not."""
    found, diagnosis = looked_up(source)
    if diagnosis is None:
        return found
    from starcal_ground.diagnosis.diagnose import found_alignment

    _, sentence = found_alignment(diagnosis)
    if not found.setup.is_aligned:
        raise OptionError(f'prior_alignment: not given, and not found: {sentence}')
    return replace(found, notes=(*found.notes, sentence))


def observe(
    source: Source,
    wanted: Wanted | None = None,
    on_image: OnImage | None = None,
    on_record: Callable[[], None] = lambda: None,
) -> Observed:
    """
    Observations of the wanted images of a source; None: of all.

    ``on_image`` is called with each decoded image, its observations and the geometry that
    predicted its stars, ``on_record`` for each image or recorded observation.  Raises BagError
    when a bag cannot be read.
    """
    measured = []
    for record in bag_topics.read(source.bags, source.topics, source.setup, on_image, wanted):
        measured.append(record)
        on_record()
    return observed_of(source, measured)


def observed_of(source: Source, measured: Sequence[StarObservations], *notes: str) -> Observed:
    """Measured observations with the air that all together show, and notes."""
    observations, note = measured, ''
    if source.through_air is not None:
        observations, note = source.through_air(measured)
    found = filter(None, (note, *notes))
    return Observed(source, measured, tuple(observations), (*source.notes, *found))


def calibrate(
    observed: Observed,
    inputs: Mapping[str, str] | None = None,
    progress: Progress = lambda _: contextlib.nullcontext(lambda: None),
) -> Campaign:
    """
    Calibration of observed bags; ``inputs`` are the digests of the input files by name.

    ``progress`` is that of the images that are measured again.  Raises TooFewObservations when
    the images do not determine the parameters to be estimated.
    """
    campaign = _solved(observed, inputs)
    again, note = _measured_again(observed, campaign.calibration, progress)
    return _solved(observed_of(observed.source, again, note), inputs) if note else campaign


def _measured_again(
    observed: Observed, calibration: Calibration, progress: Progress
) -> tuple[Sequence[StarObservations], str]:
    """
    Observations with those measured again with a calibration, and a sentence if any gained stars.

    They are those of images that matched no star; and all of a calibration that is refused for
    want of stars alone: a prior lens without its distortion leads tracking to the stars in the
    middle, but the calibration by these leads to the corners.  An image refused in the second
    attempt keeps its first observations.
    """
    source, before = observed.source, observed.measured
    failed = {check.option for check in calibration.gate if check.passed is False}
    lacks_stars = bool(failed) and failed <= _FOR_WANT_OF_STARS
    if not (calibration.accepted or lacks_stars):
        return before, ''
    # An image identified by itself is not identified by the calibration of the others either.
    if not (source.setup.has_tracker and source.topics.image):
        return before, ''
    again = ('no_match', '') if lacks_stars else ('no_match',)
    wanted = {record.time_ns for record in before if record.refusal in again}
    if not wanted:
        return before, ''
    setup = replace(source.setup, prior=calibration.geometry)
    # Alone, as the nodes measure the few images that matched nothing.
    second = bag_topics.read(
        source.bags, source.topics, setup, wanted=wanted.__contains__, is_sequence=lacks_stars
    )
    used = {record.time_ns for record in before if not (record.refusal or lacks_stars)}
    records = []
    with progress(sum(record.time_ns in wanted for record in before)) as advance:
        # In the order of the bag, as before: two images may have one stamp, of which one is used.
        for old in before:
            new = old
            if old.time_ns in wanted:
                new = next(second, old)
                advance()
            is_better = not new.refusal and old.refusal in again and new.time_ns not in used
            records.append(new if is_better else old)
            used |= {new.time_ns} if is_better else set()
    matched = sum(bool(a.refusal) - bool(b.refusal) for a, b in zip(before, records, strict=True))
    stars = sum(len(record) for record in records) - sum(len(record) for record in before)
    if lacks_stars and stars > 0:
        return records, f'the calibration lacked stars at first: {stars} more are found with it'
    if matched:
        return records, (
            f'{matched} images matched nothing at first, and are used with the calibration of the'
            ' others'
        )
    return before, ''


def _solved(observed: Observed, inputs: Mapping[str, str] | None) -> Campaign:
    setup, observations = observed.source.setup, _with_repeats(observed.observations)
    ensemble = ensemble_of(observations, setup)
    calibration, residuals = solve_with_residuals(ensemble, setup, inputs)
    notes = (*observed.notes, *_refusals(observations))
    return Campaign(setup, observations, ensemble, calibration, residuals, notes)


def _with_repeats(observations: tuple[StarObservations, ...]) -> tuple[StarObservations, ...]:
    """
    Observations with images that repeat an earlier one refused, so that a sentence says so.

    The same object where none does: what is written already needs no second writing.
    """
    marked, seen = [], Ensemble()
    for one in observations:
        if not one.refusal and (words := seen.repeats(one)):
            one = replace(one, refusal='duplicate', detail=words)
        seen = seen.add(one)
        marked.append(one)
    unchanged = all(one is other for one, other in zip(marked, observations, strict=True))
    return observations if unchanged else tuple(marked)


def _refusals(observations: Sequence[StarObservations]) -> Iterator[str]:
    """Sentences on the reasons of refused images."""
    if any(image.refusal for image in observations):
        from starcal_ground.diagnosis.bags import refusals  # slow

        for group in refusals(observations):
            detail = f' ({group.detail})' if group.detail else ''
            count = f'{group.count} of {counted(len(observations), "image")}'
            yield f'{count} refused, {group.reason}: {group.meaning}{detail}'


def ensemble_of(observations: Iterable[StarObservations], setup: Setup) -> Ensemble:
    """
    The ensemble of some images, each checked as by `solve.checked`.

    The least informative are dropped once there are twice as many as are kept, and at the end: to
    weigh all images again for each further one would take longer than to measure it.
    """
    ensemble = Ensemble()
    for image in observations:
        ensemble = ensemble.add(solve.checked(image, setup))
        if len(ensemble.images) >= 2 * setup.calibration.max_images:
            ensemble = solve.within_limit(ensemble, setup)
    return solve.within_limit(ensemble, setup)
