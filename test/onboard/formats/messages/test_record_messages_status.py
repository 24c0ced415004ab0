# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of the status of an ensemble."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from sample_records import plain, status, TIME_NS  # type: ignore[import-not-found]

from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import record_from_message, stamp_ns
from starcal_ros.formats.messages.record_messages import status_to_message
from starcal_ros.records import EnsembleStatus


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_a_status_has_every_number(make: Any) -> None:
    record = status()
    message = status_to_message(record, 'cam', make)
    assert (message.header.frame_id, stamp_ns(message.header.stamp)) == ('cam', TIME_NS)
    for name in ('images', 'images_saved', 'stars', 'min_images', 'min_stars'):
        assert getattr(message, name) == getattr(record, name)
    assert [(entry.reason, entry.count) for entry in message.refused] == [('no_match', 1)]
    assert (message.coverage_rows, message.coverage_cols) == record.coverage.shape
    assert message.coverage.tolist() == record.coverage.ravel().tolist()
    assert tuple(message.parameter_names) == record.parameter_names
    assert message.predicted_sigma.tolist() == record.predicted_sigma.tolist()


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_a_status_comes_back(make: Any) -> None:
    record = status()
    back = record_from_message(EnsembleStatus, status_to_message(record, 'cam', make))
    for field in dataclasses.fields(EnsembleStatus):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(record, field.name))
