# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Types that a bag names; the reading itself is tested with the libraries of ROS."""

from __future__ import annotations

import pytest

from starcal_ground.bags import rosbag2


def test_a_bag_cannot_name_any_module_to_be_imported() -> None:
    with pytest.raises(ValueError, match='no type of a message'):
        rosbag2.decode(memoryview(b''), 'xml/sax/handler')
