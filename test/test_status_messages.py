"""Messages of the status of an ensemble: round trips."""

from __future__ import annotations

from typing import Any

import pytest
from sample_records import assert_same, plain, status  # type: ignore[import-not-found]

from starcal_ros.bag import make_message
from starcal_ros.status_messages import status_from_message, status_to_message


@pytest.mark.parametrize('make', [plain, make_message], ids=['plain', 'rosbags'])
def test_status_round_trip(make: Any) -> None:
    """Every number of a status survives its message, bit for bit."""
    record = status()
    assert_same(record, status_from_message(status_to_message(record, 'cam', make)))
