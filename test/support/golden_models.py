"""Results of causes and of the criticism of models on made recordings, for golden tables."""

import math

from golden_runs import flight, table
import numpy as np
from ou_monitor.criticism.composite import view_of
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role
from ou_monitor.records import Recording
from term_examples import EXAMPLES, OU, term


def _throttle(n, seed=4):
    return np.repeat(np.random.default_rng(seed).uniform(0.2, 0.9, n // 50 + 1), 50)[:n]


def samples_of(n, *others, seed=11, uneven=False):
    """Return samples of the OU with other terms, 1 kHz or with steps of 1 and 2 ms."""
    rng = np.random.default_rng(seed)
    t = 1e-3 * (np.cumsum(rng.choice([1, 1, 2], n)) if uneven else np.arange(n))
    u = _throttle(n)
    model = SupplyModel((term('ou', **OU), *others))
    return Samples(t, model.simulate(t, rng, u), u)


def view_at(samples, *terms, share=1.0):
    gaussian = evaluate(samples, (term('ou', **OU), *terms))
    return view_of(samples, gaussian, gaussian.z, slice(0, round(share * samples.n)))


# Other terms needed for the likelihood of a term.
_BESIDE = {'load_dependent_noise': ('measurement_noise',)}


def terms():
    """Return a simulation of each term, scores at the truth, and the start of a fit."""
    found = {}
    for name, params in EXAMPLES.items():
        one = term(name, **params)
        beside = [term(other, std=0.02) for other in _BESIDE.get(name, ())]
        more = [] if name == 'ou' else [*beside, one]
        part = {}
        for uneven in (False, True):
            samples = samples_of(1200, *more, uneven=uneven)
            part[f'volts {uneven}'] = table(samples.voltage[::150])
            if one.ROLE in (Role.LAW, Role.EXACT):
                continue
            fit = evaluate(samples, (term('ou', **OU), *more))
            part[f'scores {uneven}'] = table([fit.z[::150], np.sqrt(fit.variance[::300]),
                                              float(fit.density.sum())])
        part['free'] = {name: [table(one.moved(name, 0.1).values()), one.per_coordinate(name)]
                        for name in one.free()}
        if one.ROLE is not Role.EXACT and name != 'ou':
            view = view_at(samples_of(4000, *more), *beside, share=0.8)
            part['candidates'] = [table(other.values()) for other in type(one).candidates(view)]
            part['holds'] = one.holds(view)
            part['beside'] = table(one.beside(term('ou', **OU)).values())
        found[name] = table(part)
    return found


_LAWS = {
    'jumps': {'rate': 2.0, 'mean': -0.06, 'std': 0.08}, 'heavy_tails': {'dof': 4.0},
    'glitches': {'probability': 0.01, 'std': 0.15},
    'volatility': {'std': 0.5, 'rate': 1.0},
    'nonlinear_restoring': {'square': 0.0, 'cube': 2000.0},
    'clock_jitter': {'std': 2.5e-4},
    'regime_switching': {'rate_up': 3.0, 'rate_down': 4.0, 'level': 0.0, 'sigma_ratio': 2.5,
                         'at_once': 1.0, 'states': 2.0}}


def laws():
    """Return laws fitted at the true OU."""
    found = {}
    for name, params in _LAWS.items():
        samples = samples_of(2000 if name == 'regime_switching' else 6000, term(name, **params))
        fit = catalogue()[name].fit_law(view_at(samples, share=0.8))
        found[name] = 'none' if fit is None else table({
            'term': fit.term.values(), 'se': fit.se, 'z': fit.z[::400], 'free': fit.free,
            'gain': float(fit.gain.sum()),
            'rest': [None if one is None else float(np.abs(one).sum())
                     for one in (fit.push, fit.error, fit.power, fit.offset)]})
    return found


def _recordings():
    """Return recordings with faults of instruments."""
    t, v, u = flight(np.random.default_rng(81), 4000)
    rng = np.random.default_rng(82)
    noise = rng.standard_normal(t.size)
    lost = np.sort(rng.permutation(t.size)[:3600])
    glitched = v.copy()
    glitched[[500, 1700]] = -9.0, 65.0
    n = 60_000
    long_t = np.arange(n) * 2e-4
    long_v = 5.0 + 0.02 * rng.standard_normal(n) + 0.02 * np.sin(2.0 * math.pi * 50.0 * long_t)
    return {
        'plain': (t, v, u), 'coarse': (t, 0.05 * np.round(v / 0.05), u),
        'clipped': (t, np.minimum(v, np.quantile(v, 0.97)), u),
        'squeezed': (t, np.minimum(v, 5.0) + 0.005 * np.log1p(np.maximum(v - 5.0, 0.0) / 0.005),
                     u), 'held': (t, np.repeat(v[::4], 4), u),
        'jittered': (np.sort(t + 2e-4 * noise), v, u), 'lost': (t[lost], v[lost], u[lost]),
        'glitched': (t, glitched, u), 'still': (t, v, 0.0 * u + 0.4),
        'none': (t, v, np.full(t.size, math.nan)), 'fast': (long_t, long_v, 0.0 * long_v)}


def integrity():
    """Return the findings about recordings before any model is fitted."""
    found = {}
    for name, (t, v, u) in _recordings().items():
        made = examine(Recording(t, v, u, name))
        one = {'exact': [[term_.NAME, term_.values()] for term_ in made.exact],
               'notes': len(made.notes),
               'drawn': None if made.drawn is None else int(made.drawn.sum())}
        if made.samples is not None:
            s = made.samples
            one['samples'] = [s.n, s.train.stop, s.t[::900], s.voltage[::400],
                              None if s.throttle is None else s.throttle[::900]]
        found[name] = table(one)
    return found


RUNS = {run.__name__: run for run in (terms, laws, integrity)}
