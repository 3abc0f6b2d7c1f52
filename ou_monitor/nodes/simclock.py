"""
Simulated time of a message that carries no stamp.

The middleware stamps every message with the wall clock of its sender.  When a
bag is replayed at four times its speed, those stamps lie four times too close
and alpha would come out four times too large.  The messages on `/clock` carry
both times, so they give the map from one to the other.
"""

from __future__ import annotations

from collections import deque

# Half a second at the usual 100 Hz: averages the jitter of single publications away, and still
# follows a change of the replay rate within that half second.
PAIRS = 50
# A clock off the line by more than this, s of the sender's time, was stepped (next pass, seek):
# no publication is that late.
STEP = 0.25


class SimClockMap:
    """
    Straight line through the last pairs (source time, clock), by least squares.

    Limits: nothing is known before two pairs have come; between pairs and
    after the last one the line is continued.
    """

    def __init__(self) -> None:
        self._pairs: deque[tuple[float, float]] = deque(maxlen=PAIRS)
        self._origin = 0.0
        self._zero = 0.0
        self._rate = 0.0

    @property
    def ready(self) -> bool:
        """Whether a source time can be mapped."""
        return len(self._pairs) >= 2

    @property
    def rate(self) -> float:
        """Seconds of simulated time per second of the sender's clock."""
        return self._rate

    def add(self, source: float, clock: float) -> bool:
        """Take one message of `/clock` (source in s, clock in s)."""
        stepped = False
        if self._pairs:
            last_source, last_clock = self._pairs[-1]
            expected = self(source) if self.ready else clock
            off = abs(clock - expected) > STEP * max(1.0, self._rate)
            if off or clock < last_clock or source < last_source:
                self._pairs.clear()
                stepped = True
            elif source == last_source:
                return False
        self._pairs.append((source, clock))
        self._fit()
        return stepped

    def _fit(self) -> None:
        """Fit the line; sums are taken about the means, so nanoseconds survive in floats."""
        n = len(self._pairs)
        first_source, first_clock = self._pairs[0]
        mean_x = sum(x - first_source for x, _ in self._pairs) / n
        mean_y = sum(y - first_clock for _, y in self._pairs) / n
        sxx = sxy = 0.0
        for source, clock in self._pairs:
            x = source - first_source - mean_x
            sxx += x * x
            sxy += x * (clock - first_clock - mean_y)
        self._rate = sxy / sxx if sxx > 0.0 else 0.0
        self._origin = first_source + mean_x
        self._zero = first_clock + mean_y

    def __call__(self, source: float) -> float:
        """Return the simulated time, s, at which a message was sent; NaN when not known yet."""
        if not self.ready:
            return float('nan')
        return self._zero + self._rate * (source - self._origin)
