# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Why a source is not calibrated, by the measurement and the calibration themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

from starcal_ground.bags import topics as bag_topics
from starcal_ground.blind.images import LOOKED_AT
from starcal_ground.campaign import calibrate, Observed, observed_of, Source
from starcal_ground.diagnosis.bags import (
    diagnose_bags,
    of_bags,
    of_most,
    refusals,
    Refused,
    refused_all_the_same,
)
from starcal_ground.diagnosis.diagnose import Diagnosis
from starcal_ros.errors import TooFewObservations
from starcal_ros.pipeline.setup import check_site

_MEASURED = 10  # images, for the reason of their refusal


def diagnose_source(source: Source) -> Diagnosis:
    """
    Why `starcal calibrate` refuses a source, or that it does not; ``none`` is its own answer.

    Of more images than `LOOKED_AT` it is asked for the first ones, by their refusals alone.
    Raises BagError when a bag cannot be read, OptionError for a camera on the ground without a
    site.
    """
    if source.through_air is None:
        check_site(source.setup.site)
    topics = bag_topics.choose_topics(source.bags, source.topics, source.setup)
    source = replace(source, topics=topics)
    if topics.observations or not source.setup.is_aligned:
        return diagnose_bags(source.bags, topics, source.setup)
    records = bag_topics.read(source.bags, topics, source.setup)
    measured = list(islice(records, _MEASURED))
    if not all(record.refusal for record in measured):
        measured += islice(records, LOOKED_AT - len(measured))
    observed = observed_of(source, measured)
    refused = refusals(observed.observations)
    most = of_most(refused, len(measured))
    diagnosis = of_bags(source.bags, topics, source.setup, most)
    return (
        _of_calibration(observed, refused, diagnosis) if diagnosis.cause == 'none' else diagnosis
    )


def _of_calibration(observed: Observed, refused: Sequence[Refused], fits: Diagnosis) -> Diagnosis:
    """Why a calibration of images is refused whose set-up fits, or that it is not."""
    count, there = len(observed.observations), observed.source.image_count
    by_images = refused_all_the_same(refused, fits, count)
    if there > count:
        if of_most(refused, count):
            return by_images
        looked = f'looked at: the first {count} of {there} images'
        return replace(fits, evidence=(*fits.evidence, looked))
    try:
        calibration = calibrate(observed).calibration
    except TooFewObservations as error:
        if of_most(refused, count):
            return by_images
        reasons: Sequence[str] = (str(error),)
    else:
        reasons = calibration.reasons
        if calibration.accepted:
            return fits
    sentence = f'{fits.sentence[:-1]}, but starcal calibrate refuses them: {reasons[0]}.'
    more = (f'also: {reason}' for reason in reasons[1:])
    return Diagnosis('refused', len(reasons), sentence, (*fits.evidence, *more))
