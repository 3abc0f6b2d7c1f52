"""The executables: `ros2 run ou_monitor NAME`, or `python -m ou_monitor.nodes NAME`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
import json
import math
import os
from pathlib import Path
import sys
from typing import Any, NoReturn

from ou_monitor.errors import InputError
from ou_monitor.nodes.run import loaded, run, run_node, spin
from ou_monitor.stream.files import write_whole

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


class _Parser(argparse.ArgumentParser):

    def error(self, message: str) -> Any:
        raise InputError(f'{message} (see --help)')


def _replay_parser() -> argparse.ArgumentParser:
    p = _Parser(prog='replay', allow_abbrev=False, description=(
        'Publish the messages of a bag with their original spacing, and /clock. Remap with '
        '--ros-args -r FROM:=TO.'))
    p.add_argument('bag', type=Path, help='.mcap file or rosbag2 directory')
    p.add_argument('--rate', type=float, default=1.0, help='speed, 1 = as recorded')
    p.add_argument('--loop', action='store_true',
                   help='begin again at the end; the clock jumps back')
    p.add_argument('--clock', type=float, default=100.0, metavar='HZ',
                   help='rate at which /clock is published (default 100, 0: never)')
    p.add_argument('--partial', action='store_true',
                   help='play the readable part of a damaged bag')
    p.add_argument('--topics', nargs='+', default=None, metavar='TOPIC',
                   help='play these topics only')
    p.add_argument('--wait', type=float, default=2.0, metavar='SECONDS',
                   help='maximum wait for a subscriber before the start (default 2)')
    p.add_argument('--json', default=None, metavar='FILE',
                   help='write a summary with the spacing error (- is stdout)')
    return p


def replay_options(arguments: list[str]) -> argparse.Namespace:
    """Return the checked options of `replay`; InputError if one is bad."""
    found = _replay_parser().parse_args(arguments)
    if not (math.isfinite(found.rate) and found.rate > 0.0):
        raise InputError(f'--rate must be a positive number, got {found.rate}')
    if not 0.0 <= found.clock <= 1e4:
        raise InputError(f'--clock must lie within 0..10000 Hz, got {found.clock}')
    if not 0.0 <= found.wait < math.inf:
        raise InputError(f'--wait must be 0 or more seconds, got {found.wait}')
    if found.json not in (None, '-'):
        file = Path(found.json)
        if os.path.lexists(file):
            raise InputError(f"--json '{file}' exists already: give another name")
        if not file.parent.is_dir():
            raise InputError(f"--json '{file}': there is no folder '{file.parent}'")
    return found


def _replay() -> int:
    # Imported only here, because Jazzy from apt lacks the packages for bags.
    from ou_monitor.nodes.player import Player
    from ou_monitor.recordings.bag import BagReader
    from rclpy.utilities import remove_ros_args
    chosen = replay_options(remove_ros_args(sys.argv)[1:])
    loaded()
    player = Player('ou_replay', BagReader(chosen.bag, partial=chosen.partial), chosen)
    try:
        summary = player.play()
    finally:
        player.destroy_node()
    if chosen.json == '-':
        print(json.dumps(summary))
    elif chosen.json:
        write_whole(Path(chosen.json), f'{json.dumps(summary)}\n'.encode(), over=False)
    return 0


def replay() -> int:
    """Publish a bag; return the exit status."""
    if {'-h', '--help'} & set(sys.argv[1:]):
        _replay_parser().print_help()
        return 0
    return run('ou_replay', _replay)


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
