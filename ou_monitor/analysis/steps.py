"""
Where throttle goes from one load level to another, and the samples after it, whitened.

Limits: throttle is a command; motors follow it some 5 to 20 ms later, which a relaxation watched
from the end of the step does not know; alpha, sigma and noise of the level count as known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.levels import HALF_WIDTH, half_width, stays
from ou_monitor.criticism.innovations import ou_filter
from ou_monitor.records import Estimate, FloatArray, NAN, Recording

# Longest way from one level to the other, s: after a slower one nothing is left to relax.
LONGEST_RAMP = 1.0
# Shorter stays at a level are passages through it, s.
SHORTEST_STAY = 0.1
# Throttle has arrived, and stays, within this share of the change.
_STILL = 0.1
# What is watched after a change: so many relaxation times of the noise, and seconds, at least.
_WATCHED, _WATCHED_S = 20.0, 0.5
_MOST = 2000
# Time constants of the exponentials that are tried beside the one that is fitted, in tau.
_BESIDE = (0.25, 4.0)


@dataclass(frozen=True)
class Step:
    """A change of load level."""

    # Numbers of the levels.
    before: int
    after: int
    leave: int  # Index of the first sample that is no longer at the level before.
    enter: int  # Index of the sample from which throttle stands still at the level after.
    # First sample of the stay before; one past the last that throttle stands still after.
    begin: int
    stop: int


def find_steps(recording: Recording, throttles: Sequence[float]) -> tuple[Step, ...]:
    """Find the changes between load levels (throttles 0..1)."""
    t, throttle = recording.t, recording.throttle
    if not np.isfinite(throttles).all():
        return ()
    width = half_width(t, throttle)
    runs = [(run.start, run.stop, k) for run, k in stays(throttle, throttles, width)
            if t[run.stop - 1] - t[run.start] >= SHORTEST_STAY]
    found = []
    for (begin, leave, before), (start, stop, after) in zip(runs, runs[1:]):
        change = abs(throttles[after] - throttles[before])
        if before == after or change < 2.0 * HALF_WIDTH or start < leave:
            continue
        if t[start] - t[leave - 1] > LONGEST_RAMP:
            continue
        stay = throttle[start:stop]
        # Where the stick jitters as wide as that, what is still is as wide as the jitter.
        wide = width if width > HALF_WIDTH else 0.0
        still = np.abs(stay - np.median(stay)) <= max(_STILL * change, wide)
        enter = start + int(still.argmax())
        moved = np.flatnonzero(~still[enter - start:])
        end = enter + int(moved[0]) if moved.size else stop
        if t[end - 1] - t[enter] >= SHORTEST_STAY:
            found.append(Step(before, after, leave, enter, begin, end))
    return tuple(found)


class Window:
    """The samples after one change, whitened."""

    def __init__(self, recording: Recording, step: Step, estimate: Estimate, rms: float,
                 before: float, later: float = 0.0) -> None:
        """Take the samples (rms in V, before in V^2, later in s)."""
        t = recording.t
        alpha = estimate.alpha if estimate.usable else math.inf
        reach = max(_WATCHED / alpha, _WATCHED_S) if math.isfinite(alpha) else 2.0 * _WATCHED_S
        stop = min(step.stop, int(np.searchsorted(t, t[step.enter] + later + reach)))
        start = min(stop, int(np.searchsorted(t, t[step.enter] + later)))
        stride = max(1, -(-(stop - start) // _MOST))
        self.since = t[start:stop:stride] - t[step.enter]
        self.voltage = recording.voltage[start:stop:stride]
        self.n = self.since.size
        noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
        if not math.isfinite(alpha):
            self.var_inf, self.noise_var = 0.0, rms * rms
            self.filter = None
            self.sd = np.full(self.n, rms)
        else:
            self.var_inf, self.noise_var = estimate.var_inf, noise * noise
            louder = np.exp(-2.0 * alpha * self.since) * max(0.0, before - self.var_inf)
            first = self.var_inf + float(louder[0])
            self.filter = ou_filter(self.since, alpha, self.var_inf, self.noise_var, first)
            self.sd = np.sqrt(self.var_inf + self.noise_var + louder)
        e = self.whitened(np.column_stack([self.voltage, np.ones(self.n)]))
        self._one = e[:, 1]
        self._y = e[:, 0] - _project(self._one, e[:, 0])
        self.rss_flat = float(self._y @ self._y)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns as standardised innovations."""
        if self.filter is None:
            return columns / math.sqrt(self.noise_var)
        e = self.filter.innovations(columns)
        return np.asarray(e / np.sqrt(self.filter.variance)[:, None])

    def rss(self, taus: FloatArray) -> FloatArray:
        """Return the residual sum of squares for each tau, level and amplitude fitted."""
        basis = self.whitened(np.exp(-self.since[:, None] / taus[None, :]))
        basis -= np.outer(self._one, self._one @ basis) / float(self._one @ self._one)
        size = np.maximum((basis ** 2).sum(axis=0), 1e-300)
        found: FloatArray = self.rss_flat - (self._y @ basis) ** 2 / size
        return found

    def more(self, tau: float) -> tuple[float, int]:
        """Return by how much exponentials beside tau lower the sum of squares, and how many."""
        times = tau * np.array((1.0, *_BESIDE))
        basis = self.whitened(np.exp(-self.since[:, None] / times[None, :]))
        basis -= np.outer(self._one, self._one @ basis) / float(self._one @ self._one)
        basis /= np.maximum(np.sqrt((basis ** 2).sum(axis=0)), 1e-300)
        found, _, rank, _ = np.linalg.lstsq(basis, self._y, rcond=1e-6)
        rest = self._y - basis @ found
        alone = self._y - basis[:, 0] * float(basis[:, 0] @ self._y)
        return max(0.0, float(alone @ alone - rest @ rest)), int(rank) - 1

    def solve(self, tau: float, scale: float) -> tuple[float, float, float, float]:
        """Return U0 and A with their standard errors; of U0 alone without a tau."""
        x = self.whitened(np.column_stack([self.voltage, np.ones(self.n)]))
        if not tau < self.since[-1]:
            size = float(x[:, 1] @ x[:, 1])
            return float(x[:, 1] @ x[:, 0]) / size, math.sqrt(scale / size), NAN, NAN
        decay = np.exp(-self.since / tau)
        x = np.column_stack([x, self.whitened(decay[:, None])])
        found = np.linalg.lstsq(x[:, 1:], x[:, 0], rcond=None)[0]
        bend = self.whitened((found[1] * decay * self.since / tau)[:, None])
        jacobian = np.column_stack([x[:, 1:], bend])
        errors = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian) * scale))
        return float(found[0]), float(errors[0]), float(found[1]), float(errors[1])


def _project(direction: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(direction * float(direction @ y) / float(direction @ direction))
