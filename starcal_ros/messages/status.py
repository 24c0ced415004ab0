"""The status of an ensemble to a message."""

from __future__ import annotations

import numpy as np

from starcal_ros.messages.fields import flat_array, make_header
from starcal_ros.messages.types import Make, Message, STATUS_TYPE
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
