# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of the status of an ensemble."""

from __future__ import annotations

import dataclasses

import numpy as np
from sample_records import status  # type: ignore[import-not-found]

from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import record_from_message
from starcal_ros.formats.messages.record_messages import status_to_message
from starcal_ros.records import EnsembleStatus


def test_a_status_comes_back() -> None:
    record = status()
    message = status_to_message(record, 'cam', make_message)
    assert message.header.frame_id == 'cam'
    back = record_from_message(EnsembleStatus, message)
    for field in dataclasses.fields(EnsembleStatus):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(record, field.name))
