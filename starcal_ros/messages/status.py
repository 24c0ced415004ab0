# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The status of an ensemble to a message and back."""

from __future__ import annotations

from starcal_ros.messages.codec import message_fields, record_fields
from starcal_ros.messages.types import Make, Message, STATUS_TYPE
from starcal_ros.records import EnsembleStatus


def status_to_message(status: EnsembleStatus, frame_id: str, make: Make) -> Message:
    """Return a starcal/EnsembleStatus; ``frame_id`` is the camera's."""
    return make(STATUS_TYPE, **message_fields(status, make, frame_id))


def status_from_message(message: Message) -> EnsembleStatus:
    """
    Status of a starcal/EnsembleStatus.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other.
    """
    return EnsembleStatus(**record_fields(EnsembleStatus, message))
