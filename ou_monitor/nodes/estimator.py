"""
Executable `estimator`: voltage and throttle -> OU estimate and brown-out risk.

ros2 run ou_monitor estimator --ros-args -r voltage:=/battery_voltage -p msg_config:=std_float64

'ros2 param describe' shows what each parameter means and its range.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_node, spin

NAME = 'ou_estimator'


def _work() -> int:
    from ou_monitor.nodes.estimator_node import EstimatorNode
    return spin(lambda: EstimatorNode(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_node(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
