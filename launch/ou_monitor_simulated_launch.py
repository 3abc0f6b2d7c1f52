"""
Start a simulated supply, with the estimator and the adaptive filter; needs no hardware.

ros2 launch ou_monitor ou_monitor_simulated_launch.py scale_resistance:=1.4
ros2 param set /supply_simulator scale_resistance 2.0

The simulator plays a throttle profile; with play:='' it uses your throttle topic.
`ou-monitor live` shows voltage, budget, risk and flag on a page.

"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

HERE = Path(__file__).resolve().parent
# Name, default, description.
ARGUMENTS = (
    ('model_file', str(HERE.parent / 'models' / 'gecko.yaml'), 'Model of the supply.'),
    ('rate', '100.0', 'Samples per second, Hz.'),
    ('play', 'flight', 'Throttle that is played: a profile, a number, points or a recording.'),
    ('scale_resistance', '1.0', 'Factor on the response to throttle: 1.4 is an old pack.'),
)
# Arguments passed on unchanged.
COMMON = (
    ('namespace', '', 'Namespace of all nodes.'),
    ('params_file', str(HERE.parent / 'config' / 'simulated.yaml'), 'Parameters of other nodes.'),
    ('use_sim_time', 'false', 'Whether time comes from /clock.'),
    ('input', 'voltage', 'Topic of the signal that is filtered.'),
    ('log_level', 'info', 'debug, info, warn, error, fatal.'),
)


def generate_launch_description():
    """Return the simulator, and the nodes as the other launch file describes them."""
    common = {name: LaunchConfiguration(name) for name, _, _ in COMMON}
    numbers = {name: ParameterValue(LaunchConfiguration(name), value_type=float)
               for name in ('rate', 'scale_resistance')}
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=text)
          for name, default, text in (*ARGUMENTS, *COMMON)),
        # First, because it sets the discovery range of all nodes.
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(HERE / 'ou_monitor_launch.py')),
            launch_arguments=common.items()),
        Node(package='ou_monitor', executable='supply_simulator', name='supply_simulator',
             namespace=common['namespace'], output='screen',
             parameters=[{'model_file': LaunchConfiguration('model_file'), **numbers,
                          'throttle.play': ParameterValue(LaunchConfiguration('play'),
                                                          value_type=str),
                          'use_sim_time': common['use_sim_time']}],
             ros_arguments=['--log-level', common['log_level']]),
    ])
