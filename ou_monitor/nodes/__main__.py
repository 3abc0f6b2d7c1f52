"""The executables: `ros2 run ou_monitor NAME`, or `python -m ou_monitor.nodes NAME`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
import sys
from typing import NoReturn

from ou_monitor.nodes.run import run_node, spin

LIFECYCLE = '--lifecycle'
_DESCRIBED = "'ros2 param describe' explains each parameter and gives its range"


@dataclass(frozen=True)
class Executable:
    """Runs one node, then ends the process with an exit status."""

    node: str  # Name of the node
    module: str  # Module of its class
    kind: str  # Name of its class
    about: str  # What --help prints
    managed: bool = False  # Whether it takes --lifecycle

    def __call__(self) -> NoReturn:
        lifecycle = self.managed and LIFECYCLE in sys.argv[1:]
        if lifecycle:
            sys.argv.remove(LIFECYCLE)
        run_node(self.node, self.about, lambda: self._work(lifecycle))

    def _work(self, lifecycle: bool) -> int:
        kind = getattr(import_module(f'ou_monitor.nodes.{self.module}'), self.kind)
        if lifecycle:
            from ou_monitor.nodes.base import managed
            kind = managed(kind)
        return spin(lambda: kind(self.node))


estimator = Executable('ou_estimator', 'estimator_node', 'EstimatorNode', rf"""
Executable `estimator`: voltage and throttle -> OU estimate and brown-out risk.

ros2 run ou_monitor estimator --ros-args -r voltage:=/battery_voltage -p msg_config:=std_float64

With {LIFECYCLE} it waits to be configured and activated (ros2 lifecycle set).
{_DESCRIBED}.
""", managed=True)

adaptive_filter = Executable('ou_adaptive_filter', 'adaptive_filter_node', 'AdaptiveFilterNode',
                             rf"""
Executable `adaptive_filter`: notches that follow the motors, a low-pass that follows sigma.

ros2 run ou_monitor adaptive_filter --ros-args -r input:=/imu -r sigma:=ou_estimator/sigma \
    -r state:=ou_estimator/state

With {LIFECYCLE} it waits to be configured and activated (ros2 lifecycle set).
{_DESCRIBED}.
""", managed=True)

adc = Executable('ou_adc', 'adc_node', 'AdcNode', f"""
Executable `adc`: the voltage of a Linux IIO or hwmon device -> ROS messages.

ros2 run ou_monitor adc --ros-args -p device:=iio:device0 -p channel:=in_voltage0 -p gain:=11.0

{_DESCRIBED}; doc/deploy.md describes the devices.
""")

supply_simulator = Executable('supply_simulator', 'supply_simulator_node', 'SupplySimulatorNode',
                              f"""
Executable `supply_simulator`: throttle -> the voltage of a saved model of a supply.

ros2 run ou_monitor supply_simulator --ros-args -p model_file:=m.yaml -p rate:=100.0

'ou-monitor discover RECORDING --save-model m.yaml' makes such a model; see
doc/simulation.md. {_DESCRIBED}.
""")


def replay() -> int:
    """Publish a bag; imported only here, because Jazzy from apt lacks the packages for bags."""
    from ou_monitor.nodes.replay import main
    return main()


EXECUTABLES: dict[str, Callable[[], int]] = {
    'estimator': estimator, 'adaptive_filter': adaptive_filter, 'adc': adc,
    'supply_simulator': supply_simulator, 'replay': replay}


def main() -> int:
    """Run the executable that the first word names; return the exit status."""
    words = sys.argv[1:2]
    if not words or words[0] not in EXECUTABLES:
        print(f"python -m ou_monitor.nodes NAME ...: {', '.join(EXECUTABLES)}", file=sys.stderr)
        return 2
    return EXECUTABLES[sys.argv.pop(1)]()


if __name__ == '__main__':
    sys.exit(main())
