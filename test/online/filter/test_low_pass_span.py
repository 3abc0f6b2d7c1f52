"""The span of low-passes against impulse responses written out."""

import math

import numpy as np
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.online.filter.learned_wiener import COUNT, CUTOFFS, LowPassSpan
import pytest

INTERVAL = 2e-3


def impulse(slope, n=4000):
    """Return what a sample of 1 makes of each output, shape (5, n)."""
    x = np.zeros(n)
    x[0] = 1.0
    out = []
    for cutoff in CUTOFFS:
        state, before, row = LowPassState(0.0), 0.0, []
        for now in x.tolist():
            ends = ((now - before) / INTERVAL,) * 2 if slope else (before, now)
            row.append(state.advance(2, 2.0 * math.pi * cutoff * INTERVAL, *ends))
            before = now
        out.append(row)
    return np.array([*out, np.diff(x, prepend=0.0) / INTERVAL if slope else x])


@pytest.mark.parametrize('slope', [False, True])
@pytest.mark.parametrize('decay', [math.inf, 63.0])
def test_covariance_of_noise(slope, decay):
    """The sum over all pairs of past samples of weights and correlation."""
    h = impulse(slope)
    lags = np.arange(h.shape[1])
    correlation = np.exp(-decay * INTERVAL * lags[1:]) if math.isfinite(decay) else 0.0 * lags[1:]
    spectrum = np.fft.rfft(np.concatenate(([1.0], correlation, [0.0], correlation[::-1])))
    past = np.fft.irfft(np.fft.rfft(h, 2 * h.shape[1]) * spectrum, axis=1)[:, :h.shape[1]]
    wanted = past @ h.T
    found = LowPassSpan(slope).noise(INTERVAL, decay)
    # Intervals are counted in 1 %, so within half of it; its power at most 4.
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)))
    assert found / scale == pytest.approx(wanted / scale, abs=0.021)


@pytest.mark.parametrize('slope', [False, True])
def test_steps_and_response(slope):
    """A step is that of the low-passes; a wave comes out as the impulse response says."""
    span, interval = LowPassSpan(slope), math.exp(0.01 * round(math.log(INTERVAL) / 0.01))
    state = np.array([0.3, -0.2, 0.5, 0.1, 0.0, 0.4, -0.3, 0.2, 1.0, 1.5])
    wanted = []
    for k, cutoff in enumerate(CUTOFFS):
        one = LowPassState(state[2 * k])
        one.slope = state[2 * k + 1]
        one.advance(2, 2.0 * math.pi * cutoff * interval, 1.0, 1.5)
        wanted += [one.y, one.slope]
    assert span.step(interval) @ state == pytest.approx(wanted, rel=1e-12)
    h = impulse(slope)
    wave = h @ np.exp(-2j * math.pi * 10.0 * INTERVAL * np.arange(h.shape[1]))
    found = span.response(INTERVAL, 10.0)
    assert found.shape == (COUNT,)
    assert np.abs(found / wave - 1.0) == pytest.approx(0.0, abs=0.01)
