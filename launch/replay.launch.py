# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Launch the nodes of integration.launch.py, and play a recorded bag to them."""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, ThisLaunchFileDir
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the nodes, the player and the arguments; those of integration.launch.py apply too."""
    arguments = [
        DeclareLaunchArgument('bag', description='an .mcap file or a bag folder'),
        DeclareLaunchArgument(
            'params', default_value='', description='former name of params_file'
        ),
        DeclareLaunchArgument(
            'params_file',
            default_value=LaunchConfiguration('params'),
            description='ROS parameter file of the camera that took the bag',
        ),
        DeclareLaunchArgument(
            'rate',
            default_value='1.0',
            description='times real time; 0: as fast as the stars are observed',
        ),
        DeclareLaunchArgument('loop', default_value='false', description='start again at the end'),
        DeclareLaunchArgument('namespace', default_value='', description='of all nodes'),
        DeclareLaunchArgument('log_level', default_value='info', description='of all nodes'),
        DeclareLaunchArgument(
            'use_sim_time',
            default_value='true',
            description='the player publishes the time of the bag on /clock, the nodes take it',
        ),
    ]
    nodes = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(
            PathJoinSubstitution([ThisLaunchFileDir(), 'integration.launch.py'])
        ),
        launch_arguments=[
            (name, LaunchConfiguration(name))
            for name in ('params_file', 'namespace', 'log_level', 'use_sim_time')
        ],
    )
    player = Node(
        package='starcal',
        executable='bag_player',
        name='bag_player',
        namespace=LaunchConfiguration('namespace'),
        parameters=[
            {
                'bag': ParameterValue(LaunchConfiguration('bag'), value_type=str),
                # Of no type: the player refuses a wrong one by its name, and the launch ends.
                'rate': LaunchConfiguration('rate'),
                'loop': LaunchConfiguration('loop'),
                'clock': LaunchConfiguration('use_sim_time'),
                # The calibrator may start last; the first observations would be lost.
                'wait_for_topic': 'observations',
            }
        ],
        ros_arguments=['--log-level', LaunchConfiguration('log_level')],
        output='screen',
    )
    return LaunchDescription([*arguments, nodes, player])
