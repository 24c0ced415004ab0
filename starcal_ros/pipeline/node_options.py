"""
Options of the nodes alone, declared where code without ROS can see them.

One parameter file serves the nodes and the tool: the tool has no use for these, but it must tell
a node's parameter from a misspelt one.
"""

from __future__ import annotations

from dataclasses import dataclass

from starcal_ros.options import option


@dataclass(frozen=True)
class NodeOptions:
    """What the lifecycle nodes share."""

    autostart: bool = option(True, 'configure and activate at start, without a manager')


@dataclass(frozen=True)
class ObserverOptions:
    """How the star observer takes its inputs."""

    image_transport: str = option(
        'raw',
        'raw: sensor_msgs/Image on image; compressed: PNG as sensor_msgs/CompressedImage on'
        ' image/compressed',
        choices=('raw', 'compressed'),
    )
    image_reliability: str = option(
        'auto',
        'reliability asked of the image publisher; auto: best_effort from one that offers no more,'
        ' else reliable (best_effort loses large images)',
        choices=('auto', 'reliable', 'best_effort'),
    )
    image_queue: int = option(20, 'images held while the one before is measured', low=1, high=1000)
    attitude_timeout_s: float = option(
        10.0, 'longest time an image waits for the attitude after it, s of wall clock', low=0.0
    )
    attitude_history_s: float = option(
        3600.0, 'how long attitude samples are kept for images still to come, s', low=1.0
    )
    camera_info_per_image: bool = option(
        False,
        'publish the calibration in force once for each image, with its header, on'
        ' image_camera_info',
    )


@dataclass(frozen=True)
class CalibratorOptions:
    """What the calibrator keeps, and what it does with a new calibration beside publishing it."""

    state_dir: str = option(
        '',
        'folder that keeps the ensemble and the calibrations from a crash to the next start;'
        ' empty: they are held in memory alone',
    )
    calibration_history: int = option(
        20, 'most calibrations kept for roll-back, the one in force included', low=2, high=10000
    )
    state_report: bool = option(
        True, 'keep in state_dir a report of what is in force and of the last refused candidate'
    )
    set_camera_info_service: str = option(
        '', 'sensor_msgs/SetCameraInfo service to hand each new calibration to; empty: none'
    )
    set_camera_info_timeout_s: float = option(
        5.0,
        'longest wait for that service, and then for its answer, before it counts as a failure, s',
        low=0.1,
        high=3600.0,
    )


@dataclass(frozen=True)
class PlayerOptions:
    """How a bag is played."""

    bag: str = option('', 'an .mcap file or a bag folder')
    rate: float = option(
        1.0, 'times real time; 0: as fast as the stars are observed', low=0.0, high=1e6
    )
    loop: bool = option(False, 'start again at the end')
    wait_for_subscribers_s: float = option(
        10.0, 'longest wait for somebody to listen to the images and attitudes, s', low=0.0
    )
    images_in_flight: int = option(
        4, 'images sent ahead of their observations where a star observer listens', low=1
    )
    clock: bool = option(False, 'publish the time of the bag on /clock, for use_sim_time')


NODE_OPTION_CLASSES = (NodeOptions, ObserverOptions, CalibratorOptions)
"""What a parameter file may hold beside the options of the stages."""
