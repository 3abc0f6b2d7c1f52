"""The launch file in launch_testing, where ROS 2 is sourced and this package built."""

from pathlib import Path
import unittest

from ament_index_python.packages import get_package_prefix, PackageNotFoundError
import pytest

pytest.importorskip('launch_testing', reason='needs a sourced ROS 2 with launch_testing')
try:
    get_package_prefix('ou_monitor')
except (PackageNotFoundError, OSError):
    pytest.skip('needs the workspace of this package', allow_module_level=True)

from launch import LaunchDescription  # noqa: E402, I100
from launch.actions import IncludeLaunchDescription  # noqa: E402
from launch.launch_description_sources import PythonLaunchDescriptionSource  # noqa: E402
from launch_testing import post_shutdown_test  # noqa: E402
from launch_testing.actions import ReadyToTest  # noqa: E402
from launch_testing.asserts import assertExitCodes  # noqa: E402

LAUNCH = Path(__file__).resolve().parents[2] / 'launch' / 'ou_monitor_launch.py'


@pytest.mark.launch_test
def generate_test_description():
    """Return both nodes in a namespace, each with a topic of another name."""
    return LaunchDescription([
        IncludeLaunchDescription(PythonLaunchDescriptionSource(str(LAUNCH)), launch_arguments={
            'namespace': 'uav1', 'voltage': '/rail', 'input': 'imu'}.items()),
        ReadyToTest()])


class TestNodes(unittest.TestCase):
    """While they run."""

    def test_topics_are_those_of_the_arguments(self, proc_output):
        """An absolute name as it is, a relative one in the namespace."""
        for topic in ('/rail', '/uav1/imu'):
            proc_output.assertWaitFor(
                f'Waiting for a publisher on {topic}', timeout=120, stream='stderr')


@post_shutdown_test()
class TestEnd(unittest.TestCase):
    """When they have ended."""

    def test_nodes_ended_with_status_0(self, proc_info):
        assertExitCodes(proc_info)
