"""
Start, spin and end a node: the same for every executable.

Exit status: 0 after SIGINT, SIGTERM or the end of the work; 2 for unusable user input, with one
FATAL line that says what is wrong and what to do; SIGALRM if ending takes longer than `END`.
Anything else is a bug and shows its traceback.  This module can be imported without ROS 2, so that
the executables can report that ROS 2 is not installed.
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

# Set before NumPy is loaded.  Matrices are small here, and BLAS threads that share a core wait for
# one another: for 0.1 s each time, in a node with real-time priority beside another task.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

BAD_INPUT = 2
# Maximum wait inside the executor, s; a signal ends the wait.
NAP = 1.0
# Timeout of ending a node, s.  Ending takes 0.02 s of CPU, and took at most 0.5 s with 12 tasks on
# two cores.  But if another process was stopped while it held a lock in shared memory, Fast DDS
# waits 10 s for the lock, during which Python does not run, and then aborts.
END = 1.0
# Variables that give Fast DDS its profiles (the older name first), or its transports.
PROFILES = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE')
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
# Set while a signal may end the process at once; set while it may interrupt creating a node.
_loading, _making = threading.Event(), threading.Event()


def one_line(text: object) -> str:
    """Return a text with each line break or run of blanks as one blank."""
    return ' '.join(str(text).split())


def run(name: str, work: Callable[[], int], args: list[str] | None = None) -> int:
    """Initialise ROS 2, do the work, shut down; return the exit status."""
    # rclpy ends the context on SIGINT and SIGTERM, and then calls the previous handler.  Python's
    # own handler would raise KeyboardInterrupt inside a callback, which the EventsExecutor turns
    # into SystemError; so `note` only records the signal.  While modules are still being loaded,
    # there is nothing to clean up, so the process ends at once.  While a node is being created, no
    # callback runs, so `note` raises an exception.
    stopped: list[int] = []
    _loading.set()

    def note(number: int, frame: object) -> None:
        if _loading.is_set():
            os._exit(0)
        stopped.append(number)
        # Only for the first signal, because a second one would interrupt the cleanup.
        if _making.is_set() and len(stopped) == 1:
            from rclpy.executors import ExternalShutdownException
            raise ExternalShutdownException

    # The handlers stay until the process ends.  After Ctrl-C, both the terminal and ros2 launch
    # send SIGINT; Python's handler would raise an exception in a destructor of the middleware,
    # which then aborts.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    try:
        return _run(name, work, args, stopped)
    finally:
        _loading.clear()


def loaded() -> None:
    """Mark that modules are loaded: a signal no longer ends the process without cleaning up."""
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
            # rclpy would ignore the argument, and use, for example, the default fmin.
            raise InputError(f"'{left[0]}' is not an option: parameters and remappings go after "
                             '--ros-args, as in --ros-args -p NAME:=VALUE -r FROM:=TO')
        return work()

    end(run(name, checked))


def end(status: int) -> NoReturn:
    """Run the exit handlers, close DDS, and exit without unloading the interpreter."""
    # Unloading takes 0.1 to 0.3 s, and waits for the threads that tabulate the risk.
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
        _choose_queues()
        try:
            rclpy.init(args=args)
        except (binding.RCLError, binding.RCLInvalidROSArgsError,
                binding.UnknownROSArgsError) as error:
            raise InputError(f'cannot read the ROS arguments: {one_line(error)}') from error
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
        # Ignore the error if a signal has ended the context while a node was being created.
        if stopped and not rclpy.ok():
            return 0
        raise
    finally:
        rclpy.try_shutdown()
        if stopped:
            # After a signal, write the last log lines of the context, which are still buffered.
            binding.rclpy_logging_fini()


def _choose_queues() -> None:
    """Make Fast DDS keep messages while the process has no CPU, unless the user configured it."""
    # By default, a queue holds 512 messages of all topics together, and is discarded with its
    # contents if the process does not read for 1 s.  Other middlewares ignore these variables.  If
    # discovery is limited to this machine, do not change the configuration, because rmw_fastrtps
    # adds its own transports then, and messages might use either set of transports.
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


def spin(make: Callable[[], Any]) -> int:
    """Create a node, spin it until its context ends, then destroy it."""
    # The EventsExecutor, which this rclpy may lack, handles 10 000 messages/s, of which the
    # SingleThreadedExecutor loses most.
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
        # Use a timer of the node, so that WATCHDOG=1 is no longer sent if the executor hangs.
        node.every(manager.interval, lambda: manager.tell('WATCHDOG=1'))
    # Freeze the loaded objects, because a garbage collection over them blocks for 40 ms, and would
    # delay the end of the process by 0.2 s.
    gc.freeze()
    manager.tell('READY=1')
    try:
        if turn(executor, node):
            node.context.try_shutdown()
    finally:
        manager.tell('STOPPING=1')
        # If ending hangs, SIGALRM ends the process; a latch is already on disk by then.
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, END)
        executor.remove_node(node)
        node.destroy_node()
    return 0


def turn(executor: Any, node: Any) -> bool:
    """Run a node's callbacks until its context ends; return whether a signal has ended it."""
    from rclpy.executors import ExternalShutdownException
    try:
        # Do not use executor.spin(), which in rclpy 7.1.6 never returns after a signal.
        while node.context.ok():
            executor.spin_once(timeout_sec=NAP)
    except ExternalShutdownException:
        return True
    return False


def make_executor() -> Any:
    """Return the EventsExecutor of this rclpy, or the plain one if it has none."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor()
    return EventsExecutor()


class ServiceManager:
    """The service manager (systemd) that has started this process, if any."""

    def __init__(self) -> None:
        self._address = os.environ.get('NOTIFY_SOCKET', '')
        # Ignore a watchdog that is set for another process.
        ours = os.environ.get('WATCHDOG_PID', str(os.getpid())) == str(os.getpid())
        span = os.environ.get('WATCHDOG_USEC', '') if self._address and ours else ''
        # Period of the watchdog message, half of the manager's timeout, s; 0: none.
        self.interval = 0.5e-6 * int(span) if span.isdigit() else 0.0

    def tell(self, state: str) -> None:
        """Send a state, such as 'READY=1'; ignore failures."""
        if not self._address:
            return
        # An abstract socket name begins with a zero byte, which NOTIFY_SOCKET writes as @.
        address = '\0' + self._address[1:] if self._address[0] == '@' else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
                out.settimeout(0.1)
                out.sendto(state.encode(), address)
        except OSError:
            return
