"""
Start one estimator for each of two batteries, in a namespace each.

ros2 launch ou_monitor ou_monitor_two_batteries_launch.py voltage_1:=/bat1 voltage_2:=/bat2

Each has its own flag and latch (in a folder given as `state_file`, files are named after the
node).  Both use the same throttle.  No filter is started: start one that subscribes to the sigma
of the battery that supplies your sensor.

"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

HERE = Path(__file__).resolve().parent
PARAMS = HERE.parent / 'config' / 'ou_monitor.yaml'
# Arguments passed on unchanged.
COMMON = (('throttle', '/throttle', 'Topic of the throttle, for both.'),
          ('use_sim_time', 'false', 'Whether time comes from /clock.'),
          ('respawn', 'false', 'Whether a node that has ended is restarted.'),
          ('log_level', 'info', 'debug, info, warn, error, fatal.'))


def generate_launch_description():
    """Return two estimators, each described by the other launch file."""
    arguments = [DeclareLaunchArgument(name, default_value=default, description=text)
                 for name, default, text in COMMON]
    groups = []
    for number in ('1', '2'):
        arguments += [
            DeclareLaunchArgument(f'namespace_{number}', default_value=f'battery_{number}',
                                  description=f'Namespace of battery {number}.'),
            DeclareLaunchArgument(f'voltage_{number}', default_value='voltage',
                                  description='Topic of its voltage; relative: in its namespace.'),
            DeclareLaunchArgument(f'params_file_{number}', default_value=str(PARAMS),
                                  description='Its parameters.')]
        of_this = {name: LaunchConfiguration(f'{name}_{number}')
                   for name in ('namespace', 'voltage', 'params_file')}
        of_both = {name: LaunchConfiguration(name) for name, _, _ in COMMON}
        groups.append(GroupAction([IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(HERE / 'ou_monitor_launch.py')),
            launch_arguments={**of_this, **of_both, 'filter': 'false'}.items())], scoped=True))
    return LaunchDescription([*arguments, *groups])
