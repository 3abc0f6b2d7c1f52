"""
Executable `replay`: publish a bag's messages with their original spacing.

ros2 run ou_monitor replay BAG [--rate R] [--loop] [--clock HZ] ...
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
import sys
from typing import Any

from ou_monitor.errors import InputError
from ou_monitor.nodes.run import loaded, run
from ou_monitor.recordings.bag import BagReader

NAME = 'ou_replay'


class _Parser(argparse.ArgumentParser):

    def error(self, message: str) -> Any:
        raise InputError(f'{message} (see --help)')


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line without ROS arguments."""
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


def options(arguments: list[str]) -> argparse.Namespace:
    """Return the checked options; InputError if one is bad."""
    found = parser().parse_args(arguments)
    if not (math.isfinite(found.rate) and found.rate > 0.0):
        raise InputError(f'--rate must be a positive number, got {found.rate}')
    if not 0.0 <= found.clock <= 1e4:
        raise InputError(f'--clock must lie within 0..10000 Hz, got {found.clock}')
    if not 0.0 <= found.wait < math.inf:
        raise InputError(f'--wait must be 0 or more seconds, got {found.wait}')
    return found


def _work() -> int:
    from ou_monitor.nodes.player import Player
    from rclpy.utilities import remove_ros_args
    chosen = options(remove_ros_args(sys.argv)[1:])
    loaded()
    player = Player(NAME, BagReader(chosen.bag, partial=chosen.partial), chosen)
    try:
        summary = player.play()
    finally:
        player.destroy_node()
    if chosen.json == '-':
        print(json.dumps(summary))
    elif chosen.json:
        try:
            Path(chosen.json).write_text(json.dumps(summary) + '\n', encoding='utf-8')
        except OSError as error:
            raise InputError(f"cannot write --json '{chosen.json}': {error.strerror}") from error
    return 0


def main() -> int:
    if any(word in ('-h', '--help') for word in sys.argv[1:]):
        parser().print_help()
        return 0
    return run(NAME, _work)
