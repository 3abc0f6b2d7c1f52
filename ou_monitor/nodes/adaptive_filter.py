r"""
Executable `adaptive_filter`: a low-pass whose cutoff follows sigma.

ros2 run ou_monitor adaptive_filter --ros-args -r input:=/imu -r sigma:=ou_estimator/sigma \
    -r state:=ou_estimator/state

With --lifecycle it waits to be configured and activated (ros2 lifecycle set).
'ros2 param describe' shows what each parameter means and its range.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_managed, spin

NAME = 'ou_adaptive_filter'


def _work(lifecycle: bool) -> int:
    from ou_monitor.nodes.adaptive_filter_node import AdaptiveFilterNode
    if not lifecycle:
        return spin(lambda: AdaptiveFilterNode(NAME))
    from ou_monitor.nodes.lifecycle import managed
    return spin(lambda: managed(AdaptiveFilterNode)(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_managed(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
