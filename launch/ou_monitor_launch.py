"""
Start the estimator, and the adaptive filter, which uses the estimator's sigma.

ros2 launch ou_monitor ou_monitor_launch.py namespace:=uav1 params_file:=my.yaml voltage:=/rail

Only this machine can discover the nodes, unless discovery_range:=SUBNET or the environment
variable changes that, because ROS 2 does not authenticate anybody (doc/security.md).

"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.conditions import IfCondition
from launch.substitutions import EnvironmentVariable, LaunchConfiguration
from launch_ros.actions import Node

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
# The folder config/ is beside launch/, both installed and in a source tree.
PARAMS = Path(__file__).resolve().parents[1] / 'config' / 'ou_monitor.yaml'
# Name, default, description.
ARGUMENTS = (
    ('namespace', '', 'Namespace of both.'),
    ('params_file', str(PARAMS), 'Parameters of both nodes.'),
    ('use_sim_time', 'false', 'Whether time comes from /clock.'),
    ('voltage', 'voltage', 'Topic of the voltage (not used if the msg_config names an absolute '
                           'topic).'),
    ('throttle', 'throttle', 'Topic of the throttle (likewise).'),
    ('input', 'input', 'Topic of the signal that is filtered.'),
    ('filter', 'true', 'Whether the adaptive filter is started.'),
    ('respawn', 'false', 'Whether a node that has ended is restarted after 2 s.'),
    ('log_level', 'info', 'debug, info, warn, error, fatal.'),
)


def refuse_missing_file(context):
    """Raise an error when there is no parameter file; ROS 2 would start with the defaults."""
    path = LaunchConfiguration('params_file').perform(context)
    if not Path(path).is_file():
        raise RuntimeError(f'params_file: there is no file {path}')


def generate_launch_description():
    """Return both nodes in one namespace, with one parameter file."""
    common = {
        'package': 'ou_monitor',
        'namespace': LaunchConfiguration('namespace'),
        'parameters': [LaunchConfiguration('params_file'),
                       {'use_sim_time': LaunchConfiguration('use_sim_time')}],
        'output': 'screen',
        'respawn': LaunchConfiguration('respawn'),
        'respawn_delay': 2.0,
    }
    level = ['--log-level', LaunchConfiguration('log_level')]
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, default, text in ARGUMENTS),
        DeclareLaunchArgument('discovery_range',
                              default_value=EnvironmentVariable(RANGE, default_value='LOCALHOST'),
                              description='Who may find the nodes: LOCALHOST, SUBNET, OFF, '
                                          'SYSTEM_DEFAULT.'),
        OpaqueFunction(function=refuse_missing_file),
        SetEnvironmentVariable(RANGE, LaunchConfiguration('discovery_range')),
        # Enclaves of security/ou_monitor_policy.xml; without SROS2 they have no effect.
        Node(executable='estimator', name='ou_estimator',
             ros_arguments=['--enclave', '/ou_monitor/estimator', *level],
             remappings=[('voltage', LaunchConfiguration('voltage')),
                         ('throttle', LaunchConfiguration('throttle'))], **common),
        Node(executable='adaptive_filter', name='ou_adaptive_filter',
             ros_arguments=['--enclave', '/ou_monitor/adaptive_filter', *level],
             condition=IfCondition(LaunchConfiguration('filter')),
             remappings=[('sigma', 'ou_estimator/sigma'), ('state', 'ou_estimator/state'),
                         ('input', LaunchConfiguration('input'))], **common),
    ])
