"""
Start the estimator and the adaptive filter, the one's sigma driving the other.

ros2 launch ou_monitor ou_monitor_launch.py namespace:=uav1 params_file:=my.yaml

They are heard on this machine alone, unless discovery_range:=SUBNET or the
environment says otherwise: ROS 2 asks nobody who he is (doc/security.md).

"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
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
        DeclareLaunchArgument('discovery_range',
                              default_value=EnvironmentVariable(RANGE, default_value='LOCALHOST'),
                              description='Who may find the nodes: LOCALHOST, SUBNET, OFF, '
                                          'SYSTEM_DEFAULT.'),
        SetEnvironmentVariable(RANGE, LaunchConfiguration('discovery_range')),
        # The enclaves of security/ou_monitor_policy.xml; without SROS2 they are names only.
        Node(executable='estimator', name='ou_estimator',
             ros_arguments=['--enclave', '/ou_monitor/estimator'], **common),
        Node(executable='adaptive_filter', name='ou_adaptive_filter',
             ros_arguments=['--enclave', '/ou_monitor/adaptive_filter'],
             remappings=[('sigma', 'ou_estimator/sigma'),
                         ('state', 'ou_estimator/state')], **common),
    ])
