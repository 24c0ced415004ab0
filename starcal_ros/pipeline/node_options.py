# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Options that only the nodes use, declared without importing ROS.

One parameter file serves the nodes and the tool: the tool ignores these options, but must
distinguish a parameter of a node from a misspelt name.
"""

from __future__ import annotations

from dataclasses import dataclass

from starcal_ros.options import option


@dataclass(frozen=True)
class NodeOptions:
    """Options shared by the lifecycle nodes."""

    autostart: bool = option(True, 'configure and activate at start, without a lifecycle manager')


@dataclass(frozen=True)
class ObserverOptions:
    """Inputs of the star observer."""

    image_transport: str = option(
        'raw',
        'raw: sensor_msgs/Image on image; compressed: PNG in sensor_msgs/CompressedImage on'
        ' image/compressed',
        choices=('raw', 'compressed'),
    )
    image_queue: int = option(
        20, 'depth of the queue of images that wait to be measured', low=1, high=1000
    )
    attitude_timeout_s: float = option(
        10.0, 'longest wait of an image for the next attitude sample, wall clock, s', low=0.0
    )


@dataclass(frozen=True)
class CalibratorOptions:
    """State of the calibrator and transfer of new calibrations."""

    state_dir: str = option(
        '',
        'folder that keeps images and calibrations across restarts; empty: memory only',
        basic=True,
        is_path=True,
    )
    state_key_file: str = option(
        '',
        'file with a secret key of at least 16 bytes; state files then carry an HMAC, and files'
        ' without a valid one are set aside; empty: checksums only, which detect damage but not'
        ' forgery',
        is_path=True,
    )
    set_camera_info_service: str = option(
        '', 'sensor_msgs/SetCameraInfo service that receives each new calibration; empty: none'
    )


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
    images_in_flight: int = option(
        4, 'images sent ahead of their observations if a star observer is running', low=1
    )
    clock: bool = option(False, 'publish the bag time on /clock, for use_sim_time')


NODE_OPTION_CLASSES = (NodeOptions, ObserverOptions, CalibratorOptions)
"""Options that a parameter file may hold besides those of the processing stages."""
