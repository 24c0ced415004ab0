# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The status of an ensemble to a message."""

from __future__ import annotations

from starcal_ros.messages.codec import message_fields
from starcal_ros.messages.types import Make, Message, STATUS_TYPE
from starcal_ros.records import EnsembleStatus


def status_to_message(status: EnsembleStatus, frame_id: str, make: Make) -> Message:
    """Return a starcal/EnsembleStatus; ``frame_id`` is the camera's."""
    return make(STATUS_TYPE, **message_fields(status, make, frame_id))
