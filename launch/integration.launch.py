# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Launch the star observer and the calibrator, and beside them the setup finder of the ground."""

from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node

from launch import LaunchDescription

TOPICS = ('image', 'attitude')


def generate_launch_description() -> LaunchDescription:
    """Return the nodes; the arguments of starcal.launch.py apply to all of them."""
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([ThisLaunchFileDir(), 'starcal.launch.py'])
        )
    )
    finder = Node(
        package='starcal',
        executable='setup_finder',
        name='setup_finder',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            LaunchConfiguration('params_file'),
            {option: LaunchConfiguration(option) for option in ('autostart', 'use_sim_time')},
        ],
        remappings=[(topic, LaunchConfiguration(topic)) for topic in TOPICS],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
        output='screen',
    )
    return LaunchDescription([nodes, finder])
