r"""
Executable `adaptive_filter`: a low-pass whose cutoff follows sigma.

ros2 run ou_monitor adaptive_filter --ros-args -r input:=/imu -r sigma:=ou_estimator/sigma \
    -r state:=ou_estimator/state

'ros2 param describe' shows what each parameter means and its range.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_node, spin

NAME = 'ou_adaptive_filter'


def _work() -> int:
    from ou_monitor.nodes.adaptive_filter_node import AdaptiveFilterNode
    return spin(lambda: AdaptiveFilterNode(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_node(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
