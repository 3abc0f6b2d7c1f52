"""
Executable `supply_simulator`: throttle -> the voltage of a saved model of a supply.

ros2 run ou_monitor supply_simulator --ros-args -p model_file:=m.yaml -p rate:=100.0

'ou-monitor discover RECORDING --save-model m.yaml' makes such a model; doc/simulation.md has the
rest, and 'ros2 param describe' what each parameter means.
"""

from __future__ import annotations

import sys

from ou_monitor.nodes.run import run_node, spin

NAME = 'supply_simulator'


def _work() -> int:
    from ou_monitor.nodes.supply_simulator_node import SupplySimulatorNode
    return spin(lambda: SupplySimulatorNode(NAME))


def main() -> int:
    """Run the executable; return the exit status."""
    return run_node(NAME, __doc__, _work)


if __name__ == '__main__':
    sys.exit(main())
