"""The status of an ensemble to a message and back."""

from __future__ import annotations

import numpy as np

from starcal_ros.message_fields import (
    counts_of_reasons,
    flat_array,
    make_header,
    shaped_array,
    stamp_ns,
)
from starcal_ros.message_types import Make, Message, STATUS_TYPE
from starcal_ros.records import EnsembleStatus


def status_to_message(status: EnsembleStatus, frame_id: str, make: Make) -> Message:
    """Return a starcal/EnsembleStatus; ``frame_id`` is the camera's."""
    rows, cols = status.coverage.shape
    return make(
        STATUS_TYPE,
        header=make_header(status.time_ns, frame_id, make),
        images=status.images,
        images_saved=status.images_saved,
        stars=status.stars,
        min_images=status.min_images,
        min_stars=status.min_stars,
        refused_reasons=list(status.refused),
        refused_counts=flat_array(list(status.refused.values()), np.uint32),
        coverage_rows=rows,
        coverage_cols=cols,
        coverage=flat_array(status.coverage, np.uint32),
        parameter_names=list(status.parameter_names),
        predicted_sigma=flat_array(status.predicted_sigma, np.float64),
    )


def status_from_message(message: Message) -> EnsembleStatus:
    """
    Ensemble status of a starcal/EnsembleStatus.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other.
    """
    shape = int(message.coverage_rows), int(message.coverage_cols)
    names = tuple(str(name) for name in message.parameter_names)
    return EnsembleStatus(
        time_ns=stamp_ns(message.header.stamp),
        images=int(message.images),
        images_saved=int(message.images_saved),
        stars=int(message.stars),
        min_images=int(message.min_images),
        min_stars=int(message.min_stars),
        refused=counts_of_reasons(message.refused_reasons, message.refused_counts),
        coverage=shaped_array('coverage', message.coverage, shape).astype(np.int64),
        parameter_names=names,
        predicted_sigma=shaped_array('predicted_sigma', message.predicted_sigma, (len(names),)),
    )
