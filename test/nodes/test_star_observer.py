# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What the threads of a star observer share, on the node itself."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import threading

from geometry_msgs.msg import TwistStamped
import pytest
from vehicle import Client, in_this_process  # type: ignore[import-not-found]

from starcal_ros.formats.messages.record_messages import calibration_to_message
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.ros.node import make_message
from starcal_ros.ros.star_observer import StarObserver

pytestmark = pytest.mark.nodes


@pytest.fixture
def observer(ros_domain: None, tiny_bag: Path) -> Iterator[StarObserver]:
    """An active star observer in this process."""
    with in_this_process(StarObserver, tiny_bag) as node:
        yield node


def test_the_worker_alone_changes_prediction_and_counts(
    observer: StarObserver, tiny_products: Path
) -> None:
    """A calibration that arrives while the worker measures waits for it."""
    busy, go_on, done = threading.Event(), threading.Event(), threading.Event()

    def hold() -> None:
        busy.set()
        assert go_on.wait(240.0)

    observer._queue.call(hold)
    assert busy.wait(240.0)
    active = read_calibration(tiny_products / CALIBRATION_FILE)
    observer._on_calibration(calibration_to_message(active, make_message))
    prior = observer._setup.prior
    assert observer._geometry is prior
    observer._queue.call(done.set)
    go_on.set()
    assert done.wait(240.0)
    assert observer._geometry is not prior


def test_the_first_image_awaits_a_velocity_that_has_a_publisher(
    observer: StarObserver, client: Client
) -> None:
    assert observer._is_told()
    client.publisher(TwistStamped, observer.resolve_topic_name('velocity'))
    client.until(lambda: not observer._is_told())
    message = TwistStamped()
    message.header.frame_id = 'icrf'
    observer.taking(observer._on_velocity)(message)
    assert observer._is_told()
