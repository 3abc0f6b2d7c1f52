"""
Nodes that a manager configures, activates and deactivates (managed nodes, design.ros2.org).

Only an active node does its work; before activation it has parameters and lifecycle services only.
A failure is logged, and the node stays in its former state.  A latched flag survives all
transitions in its file, `state_file`.  doc/deploy.md says what configuring checks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ou_monitor.errors import InputError
from ou_monitor.nodes.base import MonitorNode
from ou_monitor.nodes.run import one_line
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

SUCCESS, FAILURE, ERROR = (TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE,
                           TransitionCallbackReturn.ERROR)


def managed(kind: type[MonitorNode]) -> Callable[[str], MonitorNode]:
    """Return the unconfigured managed version of a kind of node."""
    class Managed(LifecycleNodeMixin, kind):  # type: ignore[misc, valid-type]
        """A node whose work is begun and ended by transitions."""

        def __init__(self, name: str) -> None:
            kind.__init__(self, name, managed=True)  # type: ignore[call-arg]
            LifecycleNodeMixin.__init__(self)
            change = self._service_change_state
            original = change.callback

            def answer(request: Any, response: Any) -> Any:
                # rclpy 7.1 raises if a state has no such transition, which would end the node.
                try:
                    return original(request, response)
                except Exception as error:
                    self.get_logger().error(f'no such transition now: {one_line(error)}')
                    response.success = False
                    return response
            change.callback = answer

        def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
            """Check that the node can begin; then stop it."""
            def tried() -> None:
                self.begin()
                self.stop()
            return self._done('configured', tried)

        def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('activated', self.begin)

        def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('deactivated', self.stop)

        def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('shut down', self.stop)

        def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('reset', self.stop)

        def _done(self, what: str, work: Callable[[], Any]) -> TransitionCallbackReturn:
            # rclpy would report an exception without its message.
            try:
                work()
            except InputError as error:
                self.get_logger().error(f'cannot be {what}: {error}')
                return FAILURE
            except Exception as error:
                self.get_logger().error(f'cannot be {what}: {type(error).__name__}: {error}')
                return ERROR
            return SUCCESS

    return Managed
