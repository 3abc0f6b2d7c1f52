"""The throttle of a recording, to simulate with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import FloatArray
from ou_monitor.simulation.profiles import Profile, PROFILES

# Bytes of a CSV that hold its header.
_HEAD = 4096


@dataclass(frozen=True, eq=False)
class RecordedThrottle:
    """
    Throttle as it was recorded.

    Attributes
    ----------
    profile : callable
        Stamps, s after the begin of the part, to throttle 0..1; each value holds until the next.
    duration : float
        Length of the part, s.

    """

    profile: Profile
    duration: float


def is_recording(text: str) -> bool:
    """Return whether a throttle that a user asks for is a recording: a bag, a log, a CSV of it."""
    path = Path(text)
    if text in PROFILES or not path.exists():
        return False
    if path.suffix.lower() != '.csv':
        return True
    try:
        with path.open('rb') as file:
            head = file.read(_HEAD).splitlines()
    except OSError:
        return False
    # Without voltage it is a profile: times from 0 s on, joined by straight lines.
    return bool(head) and b'voltage_v' in head[0]


def read_throttle(text: str, start: float | None = None, end: float | None = None
                  ) -> RecordedThrottle:
    """Return the throttle of a recording, of the part from start to end, s after its begin."""
    recording = read_recording(text, start=start, end=end)
    known = np.isfinite(recording.throttle)
    if not known.any():
        raise InputError(f"--throttle '{text}': the recording has no throttle")
    t, u = recording.t[known] - recording.t[0], recording.throttle[known]
    # The reader has refused percent and pulses; calibrations reach a little beyond.
    u = np.clip(u, 0.0, 1.0)

    def profile(at: FloatArray) -> FloatArray:
        # A hair later, so that a stamp that is rounded is not before its own value.
        return np.asarray(u[np.maximum(np.searchsorted(t, at + 1e-9, side='right') - 1, 0)])

    return RecordedThrottle(profile, float(recording.t[-1] - recording.t[0]))
