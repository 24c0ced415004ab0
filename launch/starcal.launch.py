# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Launch the star observer and the calibrator, with one parameter file for both."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

TOPICS = ('image', 'attitude', 'velocity', 'temperature')


def generate_launch_description() -> LaunchDescription:
    """Return both nodes and the arguments they take."""
    arguments = [
        DeclareLaunchArgument('params', description='ROS parameter file, as config/starcal.yaml'),
        DeclareLaunchArgument('namespace', default_value='', description='of both nodes'),
        DeclareLaunchArgument('log_level', default_value='info', description='of both nodes'),
        DeclareLaunchArgument(
            'autostart',
            default_value='true',
            description='configure and activate at start; false: leave it to a lifecycle manager',
        ),
        DeclareLaunchArgument(
            'use_sim_time', default_value='false', description='take the time from /clock'
        ),
        DeclareLaunchArgument(
            'respawn', default_value='false', description='start a node again that has ended'
        ),
        *(
            DeclareLaunchArgument(topic, default_value=topic, description=f'topic of the {topic}')
            for topic in TOPICS
        ),
    ]
    nodes = [
        Node(
            package='starcal',
            executable=name,
            name=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[
                LaunchConfiguration('params'),
                {
                    option: ParameterValue(LaunchConfiguration(option), value_type=bool)
                    for option in ('autostart', 'use_sim_time')
                },
            ],
            remappings=remappings,
            ros_arguments=['--log-level', LaunchConfiguration('log_level')],
            respawn=LaunchConfiguration('respawn'),
            respawn_delay=2.0,
            output='screen',
        )
        for name, remappings in (
            ('star_observer', [(topic, LaunchConfiguration(topic)) for topic in TOPICS]),
            ('calibrator', []),
        )
    ]
    return LaunchDescription([*arguments, *nodes])
