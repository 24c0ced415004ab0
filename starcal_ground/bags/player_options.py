# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameters of the node that plays bags, without ROS."""

from __future__ import annotations

from dataclasses import dataclass

from starcal_ros.options import option


@dataclass(frozen=True)
class PlayerOptions:
    """Playback of a bag."""

    bag: str = option('', 'an .mcap file or a bag folder', is_path=True)
    rate: float = option(
        1.0,
        'playback speed; 1: real time, 0: as fast as the stars are observed',
        low=0.0,
        high=1e6,
    )
    loop: bool = option(False, 'restart at the end of the bag')
    wait_for_subscribers_s: float = option(
        10.0, 'timeout of the wait for subscribers of images and attitudes, s', low=0.0
    )
    wait_for_topic: str = option(
        '', 'another topic that needs a subscriber before the playback starts'
    )
    clock: bool = option(False, 'publish the bag time on /clock, for use_sim_time')
