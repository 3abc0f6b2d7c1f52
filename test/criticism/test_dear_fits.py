"""Fits with many states, whose parameters come from a part of the samples."""

import numpy as np
from ou_monitor.criticism import structure
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import standard_errors
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import FlickerNoise


def test_what_suits_a_part_is_not_taken_where_it_is_worse_for_all(monkeypatch):
    """Where there are too many states for more rounds a fit is no worse than its start."""
    rng = np.random.default_rng(4)
    t = np.arange(8000) / 100.0
    # The part looked at is the liveliest.
    v = 5.0 + 0.02 * rng.standard_normal(t.size) * np.where(t < 30.0, 3.0, 1.0)
    samples = Samples(t, v + 0.005 * np.cumsum(rng.standard_normal(t.size)), None)
    best = fit_composite(samples, (OU(5.0, 0.1, 5.0), MeasurementNoise(0.02)), slice(0, t.size))
    monkeypatch.setattr(structure, '_DEAR', -1)
    monkeypatch.setattr(structure, '_MANY', 0)
    again = fit_composite(samples, best.terms, slice(0, t.size), best)
    assert again.density.sum() >= best.density.sum() - 1e-6
    assert again.gaussian.se[1]['std'] > 0.0


def test_a_rough_fit_of_many_states_has_no_errors_and_says_so_of_each_term():
    """One dict a term, empty or not: those of laws come after them."""
    t = np.arange(400) / 100.0
    terms = (OU(5.0, 0.1, 12.0), FlickerNoise(0.01, 0.5, 20.0))
    samples = Samples(t, SupplyModel(terms).simulate(t, np.random.default_rng(3)), None)
    fit = fit_composite(samples, terms, slice(0, samples.n), rough=True, begun=True)
    assert fit.se == ({}, {})
    found = standard_errors(samples, fit, slice(0, samples.n))
    assert len(found) == 2 and found[0]['u0'] > 0.0
