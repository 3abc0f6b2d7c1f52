"""Beside a law of the noise sigma is that of its calm or middle state, as the simulator has it."""

import math

import numpy as np
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.regime_switching import RegimeSwitching
from ou_monitor.model.terms.volatility import Volatility
import pytest

RATE, N = 200.0, 6000
T = np.arange(N) / RATE
RAIL = OU(20.0, 0.3, 5.0)


@pytest.mark.parametrize('law', [
    RegimeSwitching(1.5, 1.0, 0.0, 3.0, 1.0, 2.0), Volatility(0.8, 3.0)])
def test_what_is_fitted_spreads_as_far_as_the_data(law):
    """
    Sigma and the spread of simulations, where sigma of all would be twice as large.

    In 30 s the share of each state is known to a fifth, the mean of ln sigma to 0.8 sqrt(2/90).
    """
    voltage = SupplyModel((RAIL, law)).simulate(T, np.random.default_rng(2), None)
    samples, whole = Samples(T, voltage, None), slice(0, N)
    plain = fit_composite(samples, [RAIL], whole)
    found = fit_composite(samples, [plain.terms[0], type(law)], whole)
    assert plain.terms[0].sigma > 1.8 * RAIL.sigma
    error = 0.06 if isinstance(law, RegimeSwitching) else 2.0 * 0.8 * math.sqrt(2.0 / 90.0)
    again = fit_composite(samples, found.terms, whole, found)
    for one in (found, again):
        assert abs(math.log(one.terms[0].sigma / RAIL.sigma)) < error
    model = SupplyModel(again.terms)
    spread = [model.simulate(T, np.random.default_rng(k), None).std() for k in range(12)]
    assert np.median(spread) == pytest.approx(voltage.std(), rel=0.3)
