"""Results of causes and of the criticism of models on made recordings, for golden tables."""

from dataclasses import replace
import math

from golden_runs import flight, table
import numpy as np
from ou_monitor.analysis.level_tests import examine_level, holm
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import (
    covariates_of, criticise, simulate_bank, simulate_bank_of, statistics)
from ou_monitor.criticism.structure import evaluate, Events, fit_gaussian
from ou_monitor.discovery.decision import kinds_to_try
from ou_monitor.discovery.fitting import Fitter, standard_errors
from ou_monitor.discovery.gain import (
    cause_gain, covered, gain_of, guess, held_out, without)
from ou_monitor.discovery.load_effects import low_dips
from ou_monitor.discovery.regression import load_terms, mean_response
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role
from ou_monitor.records import Estimate, Recording, Status
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
               'raw': made.raw is not None, 'notes': len(made.notes),
               'drawn': None if made.drawn is None else int(made.drawn.sum())}
        if made.samples is not None:
            s = made.samples
            one['samples'] = [s.n, s.train.stop, s.t[::900], s.voltage[::400],
                              None if s.throttle is None else s.throttle[::900]]
        found[name] = table(one)
    return found


def criticism():
    """Return fits, statistics, banks, levels and curves of recordings with one effect each."""
    found = {}
    effects = {'none': (), 'tone': (term('tone', amplitude=0.03, frequency=50.0, phase=0.4,
                                         linewidth=0.0),),
               'slow': (term('second_relaxation', alpha=4.0, sigma=0.1),),
               'sag': (term('load_sag', linear=0.3, square=0.1),),
               'noise': (term('measurement_noise', std=0.02),),
               'sigma': (term('load_dependent_sigma', throttle=[0.0, 0.5, 1.0],
                              log_factor=[0.0, 0.5, 0.8]),),
               'jumps': (term('jumps', rate=5.0, mean=-0.1, std=0.05),),
               'glitches': (term('glitches', probability=0.01, std=0.5),)}
    for name, others in effects.items():
        samples = samples_of(3000, *others, seed=91, uneven=name == 'slow')
        ou = term('ou', **OU)
        plain = fit_composite(samples, [ou], samples.train)
        given = covariates_of(samples, plain)
        values = statistics(plain.z, given)
        part = {'plain': [plain.terms[0].values(), plain.se, plain.free, plain.score(samples)],
                'statistics': values,
                'first': statistics(plain.z, replace(given, throttle=None), lines=False)}
        # The likelihood of a second relaxation is flat: versions of SciPy differ by 1e-3.
        if others and others[0].ROLE is not Role.LAW and name != 'slow':
            full = fit_composite(samples, [ou, *others], samples.train)
            part['full'] = [[one.values() for one in full.terms], full.se, full.score(samples)]
        if name in ('none', 'tone'):
            bank = simulate_bank(given, 0.94, np.random.default_rng(1), 5)
            part['bank'] = [bank.mean, bank.std, criticise(samples, plain, bank)]
            bank = simulate_bank_of(samples, plain, np.random.default_rng(2), 3)
            part['bank of'] = [bank.mean, bank.std]
        e = Estimate(alpha=63.0, sigma=0.632, var_inf=3.2e-3, u0=5.0, noise_std=0.0, alpha_se=0.1,
                     sigma_se=0.02, var_inf_se=0.1, status=Status.OK, rate=1000.0)
        half = samples.n // 2
        halves = [(samples.t[:half], samples.voltage[:half]),
                  (samples.t[half:], samples.voltage[half:])]
        part['levels'] = holm([examine_level(halves, e), examine_level(
            halves[:1], replace(e, status=Status.NO_RELAXATION, alpha=math.nan))])
        found[name] = table(part)
    samples = samples_of(1500, seed=92)
    push, error, power = np.zeros(1500), np.zeros(1500), np.ones(1500)
    push[300], error[700], power[900:950] = 0.02, 0.01, 3.0
    fit = fit_gaussian(samples, [term('ou', **OU), term('measurement_noise', std=0.01)],
                       slice(0, 1200), Events(push, error, power, np.ones(1500)))
    found['events'] = table([[one.values() for one in fit.terms], fit.z[::150],
                             float(fit.density.sum())])
    return found


def discovery():
    """Return measures of a correct model by `discover`: gains, errors, responses, crossings."""
    found = {}
    for name, others, uneven in (
            ('sag', [term('load_sag', linear=0.3, square=0.1)], False),
            ('transient', [term('load_transient', gain=-0.2, tau=0.03, delay=0.0),
                           term('measurement_noise', std=0.01)], True),
            ('tone', [term('tone', amplitude=0.02, frequency=50.0, phase=0.4, linewidth=0.0)],
             False),
            ('sigma', [term('load_dependent_sigma', throttle=[0.0, 0.5, 1.0],
                            log_factor=[0.0, 0.5, 0.8])], False)):
        samples = samples_of(3000, *others, seed=95, uneven=uneven)
        ou = term('ou', **OU)
        every = slice(0, samples.n)
        plain = fit_composite(samples, [ou], every)
        full = fit_composite(samples, [ou, *others], every)
        less = without(samples, full, 1)
        scores = [held_out(samples, one) for one in (plain, full, less)]
        scored = covered(samples)
        fitter = Fitter(samples)
        bank = simulate_bank(covariates_of(samples, plain), 0.94, np.random.default_rng(1), 4)
        kinds = kinds_to_try(catalogue().values(), [type(plain.terms[0])], (), True, True)
        answer = mean_response(samples, plain, fitter.view(plain), load_terms(samples))
        found[name] = table({
            'errors': standard_errors(samples, full, every),
            'less': [one.values() for one in less.terms], 'guess': guess(samples).values(),
            'density': [[float(one.density.sum()), int(one.known.sum())] for one in scores],
            'covered': int(scored.sum()),
            'gains': [gain_of(scores[1], scores[0], scored),
                      cause_gain(scores[1], scores[2], scored)],
            'dips': low_dips(samples, np.zeros(samples.n), plain.terms, full.terms,
                             np.random.default_rng(2)),
            'load': [[one.NAME, one.values()] for one in load_terms(samples)],
            'answer': [[one.NAME for one in answer.terms], answer.worth, answer.rivals],
            'trials': [[one.name, float(one.evidence)] for one in fitter.trials(
                plain, kinds, lambda model: criticise(samples, model, bank))][:4]})
    return found


RUNS = {run.__name__: run for run in (
    terms, laws, integrity, criticism, discovery)}
