"""
Executable `estimator`: voltage and throttle -> OU estimate and brown-out risk.

ros2 run ou_monitor estimator --ros-args -r voltage:=/battery_voltage -p msg_config:=std_float64

With --lifecycle it waits to be configured and activated (ros2 lifecycle set).
'ros2 param describe' shows what each parameter means and its range.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_managed, spin

NAME = 'ou_estimator'


def _work(lifecycle: bool) -> int:
    from ou_monitor.nodes.estimator_node import EstimatorNode
    if not lifecycle:
        return spin(lambda: EstimatorNode(NAME))
    from ou_monitor.nodes.lifecycle import managed
    return spin(lambda: managed(EstimatorNode)(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_managed(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
