# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Launch the star observer and the calibrator, with one parameter file for both."""

from launch.actions import DeclareLaunchArgument, RegisterEventHandler, Shutdown
from launch.conditions import UnlessCondition
from launch.event_handlers import OnProcessExit
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchContext, LaunchDescription

TOPICS = ('image', 'attitude', 'velocity', 'temperature')


def end_after_error(event: ProcessExited, _context: LaunchContext) -> Shutdown | None:
    """Shut down where a process ended by an error: without it the others wait for ever."""
    # 1 of the player: it played the bag, but was not told that all messages arrived.
    if event.returncode == 0 or (event.returncode == 1 and 'bag_player' in event.process_name):
        return None
    return Shutdown(reason=f'{event.process_name} ended with status {event.returncode}')


def generate_launch_description() -> LaunchDescription:
    """Return both nodes and the arguments they take."""
    arguments = [
        DeclareLaunchArgument(
            'params',
            default_value=PathJoinSubstitution(
                [FindPackageShare('starcal'), 'config', 'starcal.yaml']
            ),
            description='former name of params_file',
        ),
        DeclareLaunchArgument(
            'params_file',
            default_value=LaunchConfiguration('params'),
            description='ROS parameter file; the default leaves camera_info_url to be set',
        ),
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
                LaunchConfiguration('params_file'),
                {
                    # Of no type: the node refuses a wrong one by its name.
                    option: LaunchConfiguration(option)
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
    errors = RegisterEventHandler(
        OnProcessExit(on_exit=end_after_error),
        condition=UnlessCondition(LaunchConfiguration('respawn')),
    )
    return LaunchDescription([*arguments, errors, *nodes])
