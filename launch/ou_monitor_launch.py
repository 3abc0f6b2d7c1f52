"""
Start the estimator and the adaptive filter, the one's sigma driving the other.

ros2 launch ou_monitor ou_monitor_launch.py namespace:=uav1 params_file:=my.yaml

"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

# Installed and in a source tree alike, config/ lies beside launch/.
PARAMS = Path(__file__).resolve().parents[1] / 'config' / 'ou_monitor.yaml'


def generate_launch_description():
    """Return both nodes in one namespace, with one parameter file."""
    common = {
        'package': 'ou_monitor',
        'namespace': LaunchConfiguration('namespace'),
        'parameters': [LaunchConfiguration('params_file'),
                       {'use_sim_time': LaunchConfiguration('use_sim_time')}],
        'output': 'screen',
    }
    return LaunchDescription([
        DeclareLaunchArgument('namespace', default_value='', description='Namespace of both.'),
        DeclareLaunchArgument('params_file', default_value=str(PARAMS),
                              description='Parameters of both nodes.'),
        DeclareLaunchArgument('use_sim_time', default_value='false',
                              description='Whether time comes from /clock.'),
        Node(executable='estimator', name='ou_estimator', **common),
        Node(executable='adaptive_filter', name='ou_adaptive_filter',
             remappings=[('sigma', 'ou_estimator/sigma'),
                         ('state', 'ou_estimator/state')], **common),
    ])
