"""Launch the star observer and the calibrator, with one parameter file for both."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return both nodes; arguments: params, namespace, image, attitude, velocity, temperature."""
    topics = ('image', 'attitude', 'velocity', 'temperature')
    arguments = [
        DeclareLaunchArgument('params', description='ROS parameter file, as config/starcal.yaml'),
        DeclareLaunchArgument('namespace', default_value='', description='of both nodes'),
        *(
            DeclareLaunchArgument(topic, default_value=topic, description=f'topic of the {topic}')
            for topic in topics
        ),
    ]
    remappings = [(topic, LaunchConfiguration(topic)) for topic in topics]
    nodes = [
        Node(
            package='starcal',
            executable=name,
            namespace=LaunchConfiguration('namespace'),
            parameters=[LaunchConfiguration('params')],
            remappings=remappings if name == 'star_observer' else [],
            output='screen',
        )
        for name in ('star_observer', 'calibrator')
    ]
    return LaunchDescription([*arguments, *nodes])
