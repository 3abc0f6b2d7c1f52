"""
What systemd is told: READY=1 when a node runs, WATCHDOG=1 while it does (sd_notify(3)).

One datagram each to the socket that NOTIFY_SOCKET names; without one nothing is done.
"""

from __future__ import annotations

import os
import socket


class ServiceManager:
    """
    The service manager that has started this process, if one has.

    Attributes
    ----------
    interval : float
        How often it is to be told that the process works, s: half of the time after which it
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
