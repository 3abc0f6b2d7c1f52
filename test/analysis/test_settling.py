"""Levels that include the settling after a change of throttle: named, and only those."""

import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.quality import Severity, unsettled
from ou_monitor.analysis.relaxation import Relaxation
from ou_monitor.model.ou import simulate
from ou_monitor.records import Estimate, Recording, Status
import pytest
from scipy.signal import lfilter
from simulated_recordings import ALPHA

GOOD = Estimate(alpha=ALPHA, sigma=0.3, var_inf=7e-4, u0=5.0, alpha_se=0.05, status=Status.OK)


def stays(tau, seed=1, seconds=2.5):
    """Return six stays at 20 and 50 %; a sag of 1 V times throttle follows with tau."""
    t = np.arange(int(6 * seconds * 1000)) / 1000.0
    throttle = np.where(np.floor(t / seconds) % 2 == 0, 0.2, 0.5)
    phi = math.exp(-1e-3 / tau)
    sag = lfilter([1.0 - phi], [1.0, -phi], throttle, zi=[phi * throttle[0]])[0]
    rng = np.random.default_rng(seed)
    noise = simulate(t, ALPHA, 0.1 + 0.2 * throttle, rng, u0=0.0)
    return Recording(t, 5.0 - sag + noise + rng.normal(0.0, 0.002, t.size), throttle)


def warned(analysis):
    """Return throttle of the levels that are said to include the settling."""
    return {x for item in analysis.quality if item.name == 'NOT_SETTLED' for x in item.throttles}


@pytest.mark.parametrize('tau, levels', [(0.2, {0.2, 0.5}), (0.1, {0.2, 0.5}), (0.016, set())])
def test_a_slow_sag_is_named_where_alpha_holds_it(tau, levels):
    """With 0.2 s alpha comes out less than half; with 16 ms nothing is left and nothing said."""
    analysis = analyze(stays(tau, seconds=4.0))
    assert warned(analysis) == set(analysis.alpha_test.withheld) == levels
    alphas = [level.estimate.alpha for level in analysis.levels]
    if tau == 0.2:
        assert max(alphas) < 0.5 * ALPHA
        text = next(item.text for item in analysis.quality if item.name == 'NOT_SETTLED')
        assert 'include the settling' in text and 'leave out only 100 ms' in text
    elif not levels:
        assert all(abs(math.log(alpha / ALPHA)) < 4.0 * level.estimate.alpha_se
                   for alpha, level in zip(alphas, analysis.levels))


def test_the_share_is_what_is_left_over_the_variance():
    """A^2 tau / 2 times the decay over what is left out, over time and Var_inf."""
    analysis = analyze(stays(0.2))
    fit = analysis.relaxations[0]
    left = sum(change.amplitude ** 2 for change in fit.releases) * 0.5 * fit.tau * (
        math.exp(-0.2 / fit.tau) - math.exp(-2.0 * fit.releases[0].duration / fit.tau))
    # So much time, and that share is just beyond 2 %, or just below.
    just = left / (0.02 * GOOD.var_inf)
    for time, said in ((0.999 * just, 1), (1.001 * just, 0)):
        items = unsettled([fit], [0.2, 0.5], [GOOD, GOOD], [time, time])
        assert len(items) == said
        assert all(i.severity is Severity.WARNING and i.throttles == (0.2,) for i in items)


def test_what_moves_on_is_named_and_what_has_no_numbers_is_not():
    """Without a tau the levels after the changes are named; an unusable one holds nothing."""
    fit = analyze(stays(0.2)).relaxations[1]
    moving = Relaxation('load', fit.releases, likelihood_gain=1e4)
    (item,) = unsettled([moving], [0.2, 0.5], [GOOD, GOOD], [7.0, 7.0])
    assert item.throttles == (0.5,) and 'keeps moving' in item.text
    assert not unsettled([moving], [0.2, 0.5], [GOOD, Estimate()], [7.0, 7.0])
    assert not unsettled([Relaxation('load', ())], [0.2, 0.5], [GOOD, GOOD], [7.0, 7.0])
