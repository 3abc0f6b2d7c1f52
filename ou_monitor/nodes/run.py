"""
Start, spin and end a node: the same for every executable.

Exit status: 0 after SIGINT, SIGTERM or the end of the work; 2 when something
the user gave cannot be used, with one FATAL line that says what and what to
do; SIGALRM where the middleware does not let go (`END`); anything else is a bug and shows its
traceback.  This module can be
imported where ROS 2 is not installed, so that the executables can say so.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
import gc
import os
from pathlib import Path
import signal
import socket
import sys
import threading
from typing import Any, NoReturn

from ou_monitor.errors import InputError, refusal

# Before NumPy is loaded.  Matrices here are small, and threads of BLAS that share a core wait for
# one another: of a node with a real-time priority beside another task, each for 0.1 s.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

BAD_INPUT = 2
# Longest wait inside the executor, s; a signal wakes it anyway.
NAP = 1.0
# Longest end of a node, s.  It takes 0.02 s of CPU, and 0.5 s at most was seen where 12 tasks
# shared two cores.  But Fast DDS waits 10 s, and then aborts, for a lock in shared memory that
# another process held when it was stopped, and while it waits nothing of Python runs.
END = 1.0
# How Fast DDS is told where its profiles are (the older name first), or its transports.
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
# Set while a signal may end the process at once, and while it may break off the making of a node.
_loading, _making = threading.Event(), threading.Event()


def one_line(text: object) -> str:
    """Return a text with its line breaks and runs of blanks made single blanks."""
    return ' '.join(str(text).split())


def run(name: str, work: Callable[[], int], args: list[str] | None = None) -> int:
    """Initialise ROS 2, do the work, shut down; return the exit status."""
    # rclpy ends the context on SIGINT and SIGTERM and then calls the handler that was there
    # before.  Python's own would raise KeyboardInterrupt inside whatever callback runs, and the
    # EventsExecutor turns that into SystemError: so ours only notes the signal.  While modules
    # are still being loaded there is nothing to be ended in order: the process ends at once.
    # While a node is being made no callback runs, and it is left as for any error.
    stopped: list[int] = []
    _loading.set()

    def note(number: int, frame: object) -> None:
        if _loading.is_set():
            os._exit(0)
        stopped.append(number)
        # Only the first: another would break off what it has begun.
        if _making.is_set() and len(stopped) == 1:
            from rclpy.executors import ExternalShutdownException
            raise ExternalShutdownException

    # They stay until the process ends.  With Ctrl-C both the terminal and ros2 launch send SIGINT,
    # and Python's handler would raise in a destructor of the middleware, which aborts.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    try:
        return _run(name, work, args, stopped)
    finally:
        _loading.clear()


def loaded() -> None:
    """Have signals only noted from here on: there is a node, or something else to be ended."""
    _loading.clear()


def run_node(name: str, about: str, work: Callable[[], int]) -> NoReturn:
    """Run an executable that takes ROS arguments only."""
    if {'-h', '--help'} & set(sys.argv[1:]):
        print(about.strip())
        sys.exit()

    def checked() -> int:
        from rclpy.utilities import remove_ros_args
        left = remove_ros_args(sys.argv)[1:]
        if left:
            # rclpy would start without it: with another fmin, say, than was asked for.
            raise InputError(f"'{left[0]}' is not taken: parameters and remappings go behind "
                             '--ros-args, as in --ros-args -p NAME:=VALUE -r FROM:=TO')
        return work()

    end(run(name, checked))


def end(status: int) -> NoReturn:
    """
    End the process; all that wants order, the participant of DDS too, is closed before.

    Left to itself the interpreter takes its modules down for 0.1 to 0.3 s, and waits for threads
    that make tables of the risk.
    """
    gc.collect()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _run(name: str, work: Callable[[], int], args: list[str] | None, stopped: list[int]) -> int:
    try:
        import rclpy
        from rclpy.impl.implementation_singleton import rclpy_implementation as binding
    except ImportError as error:
        print(f'{name}: ROS 2 is not installed: {one_line(error)}; source '
              '/opt/ros/jazzy/setup.bash, or run ./scripts/demo once and use its .venv',
              file=sys.stderr)
        return BAD_INPUT
    from rclpy.exceptions import (
        InvalidHandle, NameValidationException, NotInitializedException, ParameterException)
    from rclpy.executors import ExternalShutdownException
    try:
        _init(rclpy, binding, args)
        return 0 if stopped else work()
    except (InputError, ParameterException, NameValidationException) as error:
        rclpy.logging.get_logger(name).fatal(one_line(error))
        return BAD_INPUT
    except OSError as error:
        rclpy.logging.get_logger(name).fatal(one_line(refusal(error)))
        return BAD_INPUT
    except ExternalShutdownException:
        return 0
    except (binding.RCLError, InvalidHandle, NotInitializedException):
        # A signal has ended the context while a node was being built: that is no failure.
        if stopped and not rclpy.ok():
            return 0
        raise
    finally:
        rclpy.try_shutdown()
        if stopped:
            # The signal has ended the context, but not the log file: its last lines wait.
            binding.rclpy_logging_fini()


def _choose_queues() -> None:
    """
    Have Fast DDS keep what arrives without CPU, unless the user has chosen otherwise.

    Its own queue holds 512 messages of all topics together, and is given up after 1 s.  Other
    middlewares do not read these variables.  Where discovery is limited to this machine,
    rmw_fastrtps adds transports of its own, and which of two takes a message is left to chance.
    """
    beside = (Path('DEFAULT_FASTRTPS_PROFILES.xml'), Path('DEFAULT_FASTDDS_PROFILES.xml'))
    local = (os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', '').upper() in ('LOCALHOST', 'OFF')
             or os.environ.get('ROS_LOCALHOST_ONLY') == '1')
    if (local or any(name in os.environ for name in PROFILES)
            or any(path.exists() for path in beside)
            or os.environ.get(TRANSPORTS, 'DEFAULT') != 'DEFAULT'):
        return
    from ou_monitor.stream.config import msg_config_dir
    path = str(msg_config_dir().parent / 'config' / 'fastdds.xml')
    os.environ.update(dict.fromkeys(PROFILES, path))


def _init(rclpy: Any, binding: Any, args: list[str] | None) -> None:
    """Initialise rclpy; a command line or parameter file it cannot read is bad input."""
    _choose_queues()
    try:
        rclpy.init(args=args)
    except (binding.RCLError, binding.RCLInvalidROSArgsError,
            binding.UnknownROSArgsError) as error:
        raise InputError(f'cannot read the ROS arguments: {one_line(error)}') from error


def spin(make: Callable[[], Any]) -> int:
    """
    Make one node and spin it until its context ends, then destroy it.

    The EventsExecutor takes 10 000 messages/s where the SingleThreadedExecutor
    loses most of them; it is used where this rclpy has it.
    """
    from rclpy.executors import ExternalShutdownException
    executor = make_executor()
    loaded()
    _making.set()
    try:
        node = make()
    finally:
        _making.clear()
    executor.add_node(node)
    manager = ServiceManager()
    if manager.interval:
        # By a timer of the node: an executor that serves no timers is one that hangs.
        node.every(manager.interval, lambda: manager.tell('WATCHDOG=1'))
    # What is loaded stays: a collector that looks through it holds all up for 40 ms, and the end
    # of the process for 0.2 s.
    gc.freeze()
    manager.tell('READY=1')
    try:
        # Not spin(): in rclpy 7.1.6 the EventsExecutor's goes on for ever after a signal.
        while node.context.ok():
            executor.spin_once(timeout_sec=NAP)
    except ExternalShutdownException:
        node.context.try_shutdown()
    finally:
        manager.tell('STOPPING=1')
        # A latch is on disk since it was told; by default this signal ends the process.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, END)
        executor.remove_node(node)
        node.destroy_node()
    return 0


def make_executor() -> Any:
    """Return the EventsExecutor of this rclpy, or the plain one where there is none."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor()
    return EventsExecutor()


class ServiceManager:
    """
    The service manager that has started this process, if one has.

    `interval`, s, is how often it is told that the process works: half of the time after which it
    would end the process; 0: not at all.
    """

    def __init__(self) -> None:
        self._address = os.environ.get('NOTIFY_SOCKET', '')
        # Where a watchdog is set for another process, it is not ours to feed.
        ours = os.environ.get('WATCHDOG_PID', str(os.getpid())) == str(os.getpid())
        span = os.environ.get('WATCHDOG_USEC', '') if self._address and ours else ''
        self.interval = 0.5e-6 * int(span) if span.isdigit() else 0.0

    def tell(self, state: str) -> None:
        """Send one state, 'READY=1'; what cannot be sent is left out, for nothing can be done."""
        if not self._address:
            return
        # An abstract name begins with a zero byte, which the variable writes as @.
        address = '\0' + self._address[1:] if self._address[0] == '@' else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
                out.settimeout(0.1)
                out.sendto(state.encode(), address)
        except OSError:
            return
