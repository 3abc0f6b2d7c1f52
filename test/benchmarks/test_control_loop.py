"""The control loop of an adaptive D term: quiet at the defaults, and where it starts to hunt."""

from dataclasses import replace

from control_loop import fly, judge, Loop
import numpy as np
import pytest

SECONDS = 24.0
# A threshold just above the sigma of a quiet hover, 0.632 V/sqrt(s).
THRESHOLD = {'law': 'threshold', 'sigma_ref': 0.72}


@pytest.mark.parametrize('coupling', [0.1, 1.0, 3.0])
def test_no_limit_cycle_at_the_defaults(coupling):
    """Up to noise of the gyro that moves the motors by a third of their range."""
    verdict = judge(Loop(coupling=coupling), SECONDS)
    assert not verdict.cycle and verdict.swing < 0.3
    assert verdict.command < 0.4


def test_a_steep_load_hunts_even_at_the_defaults():
    """Where sigma grows with the cube of the load: not at a weak coupling, from 1.5 on it does."""
    loop = Loop(steepness=3.0)
    assert not judge(replace(loop, coupling=0.3), SECONDS).cycle
    above = judge(replace(loop, coupling=1.5), SECONDS)
    assert above.cycle and above.swing > max(0.7, 5.0 * above.quiet)


def test_a_kalman_filter_of_limited_lag_does_not_hunt():
    """What it learns moves the cutoff of its lag, no more than with the loop cut."""
    verdict = judge(Loop(coupling=1.5, steepness=3.0, filter={
        'law': 'kalman', 'coupling': 1.5, 'n0': 1e-7, 'max_lag': 20.0}), SECONDS)
    assert not verdict.cycle and verdict.swing < 1.2 * verdict.quiet


def test_a_threshold_hunts_from_a_coupling_on_unless_it_is_slow():
    """The paper's switch: below, sigma stays on its side; above, the loop swings to and fro."""
    loop = Loop(filter=THRESHOLD)
    assert not judge(replace(loop, coupling=0.3), SECONDS).cycle
    above = judge(replace(loop, coupling=4.0), SECONDS)
    assert above.cycle and above.swing > 1.0
    # Twice the delay of the window is 2 s; the way of the cutoff between its limits comes to it.
    assert 1.0 < above.period < 8.0
    # With the loop cut sigma never reaches the threshold; a slow cutoff no longer swings as far.
    assert above.quiet < 0.1
    slow = replace(loop, coupling=4.0, filter={**THRESHOLD, 'slew': 0.1})
    assert judge(slow, SECONDS).swing < 0.5 * above.swing


def test_the_loop_is_closed():
    """Noise that the D term passes on reaches sigma, and the voltage sags for it."""
    quiet, loud = (fly(Loop(coupling=c), 6.0, 1) for c in (0.0, 4.0))
    half = quiet.t.size // 2
    assert loud.command[half:].mean() > 5.0 * quiet.command[half:].mean()
    assert loud.sigma[half:].mean() > 1.1 * quiet.sigma[half:].mean()
    cut = fly(Loop(coupling=4.0, closed=False), 6.0, 1)
    # Alone the sag, and with it the collective, moves sigma then.
    assert cut.sigma.std() < 0.05 * cut.sigma.mean()
    seen = loud.seen[np.isfinite(loud.seen)][-20:]
    assert np.mean(seen) == pytest.approx(loud.sigma[-40:].mean(), rel=0.1)


def test_same_seed_same_flight():
    one, other = (fly(Loop(), 3.0, 7) for _ in range(2))
    np.testing.assert_array_equal(one.cutoff, other.cutoff)
    np.testing.assert_array_equal(one.turn, other.turn)
    assert np.isfinite(one.turn).all() and one.turn.max() < 1.0
