# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Contents of a source and why it is not calibrated, by measuring and calibrating it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field, replace
from itertools import islice
import math
from pathlib import Path

from starcal_ground.bags import reader
from starcal_ground.bags import topics as bag_topics
from starcal_ground.bags.contents import topic_contents, TopicContent
from starcal_ground.campaign import (
    calibrate,
    Campaign,
    looked_up,
    Observed,
    observed_of,
    Progress,
    Source,
)
from starcal_ground.diagnosis.bags import (
    diagnose_bags,
    of_most,
    of_refusals,
    placed,
    refusals,
    Refused,
)
from starcal_ground.diagnosis.diagnose import Diagnosis
from starcal_ground.file_kinds import explained
from starcal_ground.products import NotCalibrated, refused_stars
from starcal_ros.errors import BagError, OptionError, StarcalError, TooFewObservations
from starcal_ros.records import StarObservations
from starcal_ros.sky.attitude import AttitudeOptions

_MEASURED = 10  # images; if none of them matches, those after them need not be measured


@dataclass(frozen=True)
class Contents:
    """
    Contents of bags as a calibration reads them.

    ``chosen`` are the topics that it reads, None if they are ambiguous or missing, ``images`` the
    number of their images, or of recorded observations, and ``looked_at`` that of the images with
    a verdict.  ``longest_attitude_gap_s`` is between the attitude samples around an accepted
    image; NaN if none records it.  ``stars_per_image`` (accepted images) and ``refused_stars`` (by
    reason) are empty if no stars were measured; an image may still be refused for its stars then.
    """

    bags: tuple[str, ...]
    topics: tuple[TopicContent, ...]
    damage: tuple[str, ...]
    chosen: bag_topics.Topics | None = None
    images: int = 0
    looked_at: int = 0
    refused: tuple[Refused, ...] = ()
    longest_attitude_gap_s: float = math.nan
    stars_per_image: tuple[int, ...] = ()
    refused_stars: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Examined:
    """Contents of a source, why it is or is not calibrated, and notes for the user."""

    contents: Contents
    diagnosis: Diagnosis
    notes: tuple[str, ...] = ()


def examine(
    source: Source, progress: Progress = lambda _: contextlib.nullcontext(lambda: None)
) -> Examined:
    """
    Contents of a source, and why `starcal calibrate` refuses it, or that it does not.

    ``none`` is its own answer.  All images are measured, unless the first ten match nothing and
    the set-up is wrong.  Raises BagError when a bag is missing or not a bag.
    """
    try:
        return _measured(source, progress)
    except (BagError, OptionError) as error:
        return without_setup(source.bags, source.topics, error)


def without_setup(
    bags: Sequence[Path], requested: bag_topics.Topics, error: StarcalError
) -> Examined:
    """
    Contents of bags whose set-up is not found, for this error.

    Their images are checked against the attitudes only, at the default limits.  Raises BagError
    when a bag is missing or not a bag.
    """
    chosen, seen = None, list[StarObservations]()
    with contextlib.suppress(BagError, OptionError):  # one of which is the error
        if bag_topics.without_attitudes(bags, requested, {}):
            chosen = bag_topics.Topics(image=bag_topics.choose_image_topic(bags, requested))
        else:
            chosen = bag_topics.choose_topics(bags, requested)
        if chosen.observations:
            seen += reader.read_observations(bags, chosen.observations)
        else:
            seen += placed(bags, chosen, AttitudeOptions())
    contents = _contents(bags, chosen, seen, len(seen))
    sentence, of_all = f'Cannot be calibrated: {explained(error)}.', None
    if all(one.refusal for one in seen):
        of_all = of_refusals(contents.refused, len(seen))
    return Examined(
        contents, Diagnosis('refused', 1, sentence, mend=of_all.mend if of_all else ())
    )


def _measured(source: Source, progress: Progress) -> Examined:
    """`examine`, with its errors raised."""
    wrong = None
    source, unaligned = looked_up(source)
    bags, topics, setup = source.bags, source.topics, source.setup
    if unaligned and not setup.is_aligned:
        return Examined(_contents(bags, topics, (), 0), unaligned)
    count = source.image_count
    with progress(count) as advance:
        records = _counted(bag_topics.read(bags, topics, setup), advance)
        seen = list(islice(records, _MEASURED))
        none_matches = {one.refusal for one in seen} == {'no_match'}
        if none_matches and topics.image and not unaligned and count > len(seen):
            wrong = diagnose_bags(bags, topics, setup, refusals(seen))
        if wrong is None or wrong.cause == 'none':
            wrong = None
            seen += records
    observed = observed_of(source, seen)
    contents = _contents(bags, topics, observed.observations, count)
    diagnosis = unaligned or wrong or _why_refused(observed, contents.refused, progress)
    return Examined(contents, diagnosis, observed.notes[len(source.notes) :])


def _counted(
    records: Iterator[StarObservations], advance: Callable[[], None]
) -> Iterator[StarObservations]:
    for record in records:
        yield record
        advance()


def _contents(
    bags: Sequence[Path],
    chosen: bag_topics.Topics | None,
    seen: Sequence[StarObservations],
    images: int,
) -> Contents:
    damage: dict[str, None] = {}  # an ordered set
    used = [one for one in seen if not one.refusal]
    return Contents(
        bags=tuple(map(str, bags)),
        topics=topic_contents(bags, lambda text: damage.setdefault(text)),
        damage=tuple(damage),
        chosen=chosen,
        images=images,
        looked_at=len(seen),
        refused=refusals(seen),
        longest_attitude_gap_s=max(
            (one.attitude_gap_s for one in used if math.isfinite(one.attitude_gap_s)),
            default=math.nan,
        ),
        stars_per_image=tuple(len(one) for one in used) if any(map(len, used)) else (),
        refused_stars=refused_stars(used),
    )


def _why_refused(observed: Observed, refused: Sequence[Refused], progress: Progress) -> Diagnosis:
    """Why a calibration is refused by its set-up, its images or its gate, or that it is not."""
    source, count = observed.source, len(observed.observations)
    fits = Diagnosis('none', None, 'There is nothing to diagnose in recorded observations.')
    if source.topics.image:
        most = of_most(refused, count)
        fits = diagnose_bags(source.bags, source.topics, source.setup, most)
    if fits.cause != 'none':
        return fits
    try:
        calibration = calibrate(observed, progress=progress).calibration
    except TooFewObservations as error:
        if of_most(refused, count):
            return _all_the_same(refused, fits, count)
        reasons: Sequence[str] = (str(error),)
    else:
        reasons = calibration.reasons
        if calibration.accepted:
            alone = () if source.setup.has_tracker else ('the camera alone can be calibrated',)
            return replace(fits, evidence=(*fits.evidence, *alone))
    sentence = f'{fits.sentence[:-1]}, but starcal calibrate refuses them: {reasons[0]}.'
    more = (f'also: {reason}' for reason in reasons[1:])
    return Diagnosis('refused', len(reasons), sentence, (*fits.evidence, *more))


def _all_the_same(refused: Sequence[Refused], fits: Diagnosis, images: int) -> Diagnosis:
    """The refusals of so many images whose set-up fits, as their cause."""
    by_images = of_refusals(refused, images) or fits
    # The remedy of the others is to ask for this diagnosis.
    mend = () if by_images.cause == 'no_match' else by_images.mend
    return replace(by_images, evidence=(*fits.evidence, *by_images.evidence), mend=mend)


def calibrated(observed: Observed, inputs: Mapping[str, str] | None = None) -> Campaign:
    """`calibrate`, whose error names the cause and has the counts of `failure_of`."""
    try:
        return calibrate(observed, inputs)
    except TooFewObservations as error:
        raise TooFewObservations(failure_of(error, observed).reason) from error


def failure_of(error: TooFewObservations, observed: Observed) -> NotCalibrated:
    """Record of a failed calibration: counts, and the cause for which most images are refused."""
    source, images = observed.source, observed.observations
    groups = refusals(images)
    refused = {group.reason: group.count for group in groups}
    used = [one for one in images if not one.refusal]
    record = NotCalibrated(
        str(error) if used or not images else f'no image of {len(images)} can be used',
        tuple(map(str, source.bags)),
        refused,
        images_used=len(used),
        stars_used=sum(map(len, used)),
        stars_refused=refused_stars(images),
    )
    reason = f'{record.reason} ({"; ".join(record.counts)})'
    cause = _cause_of_refusals(observed, groups)
    if cause is None:
        return replace(record, reason=reason)
    command = 'starcal diagnose' if source.setup.has_tracker else ''
    return replace(
        record,
        reason=f'{cause.in_a_sentence(command)} {reason[0].upper()}{reason[1:]}',
        cause=cause.cause,
        evidence=cause.evidence,
        mend=cause.mend,
    )


def _cause_of_refusals(observed: Observed, groups: Sequence[Refused]) -> Diagnosis | None:
    """The cause for which most are refused, by a diagnosis where all are; None if none shows."""
    source, count = observed.source, len(observed.observations)
    refused = of_most(groups, count)
    if not (source.topics.image and 0 < sum(group.count for group in refused) == count):
        return of_refusals(refused, count)
    try:
        fits = diagnose_bags(source.bags, source.topics, source.setup, refused)
    except BagError:
        return None
    return fits if fits.cause != 'none' else _all_the_same(refused, fits, count)
