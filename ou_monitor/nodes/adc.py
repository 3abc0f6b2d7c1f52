"""
Executable `adc`: the voltage of a Linux IIO or hwmon device -> ROS messages.

ros2 run ou_monitor adc --ros-args -p device:=iio:device0 -p channel:=in_voltage0 -p gain:=11.0

'ros2 param describe' shows what each parameter means and its range; doc/deploy.md where such a
device comes from.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_node, spin

NAME = 'ou_adc'


def _work() -> int:
    from ou_monitor.nodes.adc_node import AdcNode
    return spin(lambda: AdcNode(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_node(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
