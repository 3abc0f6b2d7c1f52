"""Results of online parts and of the criticism in edge cases, for golden tables."""


from golden_models import samples_of, view_at
from golden_runs import table
import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.fitting import from_spectrum
from ou_monitor.model.terms.regime_switching import RegimeSwitching, SwitchingLevels
from ou_monitor.online.risk.flag import BrownoutFlag
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.online.trust import patience, StampWatch
from ou_monitor.records import MOST_STAMP
from ou_monitor.timeline import MOST_THROTTLE, MOST_VOLTAGE, plausible
from term_examples import EXAMPLES, OU, term


def flags():
    """Return levels, reasons and dips of the flag for dips, late and odd samples, and clocks."""
    found = []
    for more in ({}, {'brownout_latch': True, 'brownout_hold': 0.3}, {'brownout_delay': 0.5},
                 {'brownout_floor_time': 0.2, 'stale_after': 0.4}, {'brownout_floor': 0.0}):
        rng = np.random.default_rng(111)
        flag = BrownoutFlag(MonitorSettings(brownout_voltage=4.5, **more))
        rows = []
        t, arrival = 0.0, 0.0
        for k in range(90):
            n = int(rng.integers(1, 12))
            dt = (0.005, 0.02, 0.1)[k // 30]
            stamps = t + dt * np.arange(1, n + 1)
            v = 4.9 + 0.02 * rng.standard_normal(n)
            if k % 13 in (5, 6):
                v -= 0.7
            if k % 7 == 3:
                v[n // 2] = (0.0, np.nan, 4.29)[k % 3]
            if k % 17 == 9:
                stamps -= 0.3
            if k == 50:
                flag.new_time_line()
                stamps -= 100.0
            t, arrival = float(stamps[-1]), arrival + n * dt
            if k % 19 == 11:
                arrival += 1.5
                t += 1.5
            flag.push(stamps, v, None if k % 5 else arrival - dt * np.arange(n)[::-1] * (k % 2))
            risk = (0.001, 0.02, 0.2, np.nan)[(k // 4) % 4]
            state = flag.update(arrival, risk, fresh=k % 11 != 4, arriving=k % 23 != 20)
            rows.append([state.level.name, state.brownout, state.since, state.age, state.low,
                         state.dips])
            if k in (40, 70):
                rows.append([flag.clear()])
            if k == 60:
                flag.set_critical('told')
        found.append(table(rows))
    return found


def stamps():
    """Return the quality of stamps and readings, batch by batch."""
    rng = np.random.default_rng(121)
    found = []
    for late in (0.0, 0.08, 0.15, 0.6):
        watch, t, rows = StampWatch(), 0.0, ''
        for k in range(60):
            n = int(rng.integers(1, 15))
            batch = t + 0.01 * np.arange(1, n + 1)
            batch[rng.random(n) < late] -= 0.2
            batch[rng.random(n) < 0.02] = np.nan
            if 20 <= k < 26:
                batch[:] = t
            if k == 40:
                watch.start_anew()
            t = max(t, float(np.nanmax(np.append(batch, t))))
            watch.push(batch, None if k % 2 else 5.0 + 0.05 * k + 0.001 * np.arange(n))
            rows += watch.judge(0.3, 0.01).name[0]
        found.append(rows)
    settings = MonitorSettings(stale_after=0.8)
    found.append(table([patience(settings, rate, n) for rate in (0.0, 10.0, 500.0, 1500.0)
                        for n in (19, 20, 5000)]))
    found.append(table([plausible(np.array(values), most) for values, most in (
        ([1.0, 1e9, 1e19, np.nan], MOST_STAMP), ([5.0, 1e6, 1.0001e6, -1e7], MOST_VOLTAGE),
        ([2.0, 2.01, -2.0, np.nan], MOST_THROTTLE))]))
    return found


def chains():
    """Return outputs of long runs of filters: sample by sample for low-passes, and as arrays."""
    rng = np.random.default_rng(131)
    n = 7000
    t = np.cumsum(rng.choice([1.95e-3, 2e-3, 2.05e-3], n))
    x = 0.5 * np.sin(9.0 * t) + 0.4 * rng.standard_normal(n) * (1.0 + (t > 8.0))
    found = []
    for options in ({}, {'n0': 1e-4, 'order': 1}, {'mode': 'derivative', 'n0': 1e-4},
                    {'max_lag': 8.0}):
        one = AdaptiveLowPass(law='kalman', coupling=1.0, **options)
        for begin in range(0, n, 1400):
            part = slice(begin, begin + 1400)
            y = one.filter(t[part], x[part], 0.6, sigma_se=0.1)
            found.append(table([y[::350], one.cutoff, one.phase_lag, one.bound.name]))
    even = 2e-3 * np.arange(n)
    for options in ({}, {'order': 1}, {'mode': 'derivative'}, {'smoothing': 0.0, 'slew': 0.0},
                    {'smoothing': 0.0}, {'slew': 0.0}, {'dead_band': 0.0}, {'shadow': True},
                    {'law': 'threshold'}):
        for stamps_ in (even, t):
            for sigma in (np.repeat(rng.uniform(0.1, 1.5, 7), 1000), np.full(n, 0.3)):
                one, other = AdaptiveLowPass(**options), AdaptiveLowPass(**options)
                y = one.filter(stamps_, x, sigma, sigma_se=0.05)
                single = [other.step(*row) for row in zip(
                    stamps_[:1500].tolist(), x[:1500].tolist(), sigma[:1500].tolist(),
                    np.full(1500, 0.05).tolist())]
                found.append(table([y[::900], single[::300], one.cutoff, other.cutoff, one.wanted,
                                    one.bound.name]))
    return found


def latent():
    """Return starts of fits with one more state, and laws with levels or three states."""
    found = {}
    for name, others, more in (
            ('second', [], [term('second_relaxation', alpha=4.0, sigma=0.1)]),
            ('driven', [term('load_dependent_sigma', throttle=[0.0, 1.0], log_factor=[0.0, 0.6]),
                        term('load_dependent_alpha', slope=0.5),
                        term('measurement_noise', std=0.01),
                        term('load_dependent_noise', **EXAMPLES['load_dependent_noise'])],
             [term('resonance', frequency=120.0, damping=40.0, std=0.03, tilt=-0.5)])):
        samples = samples_of(4000, *others, *more, seed=151)
        ou = term('ou', **OU)
        # At the truth, because fits of a flat likelihood depend on the version of SciPy.
        gaussian = evaluate(samples, [ou, *others])
        composite = Composite((ou, *others), (), gaussian, gaussian.z, gaussian.density, 3, 0.0)
        terms, gain = from_spectrum(samples, composite, [*composite.terms, *more])
        found[name] = table([[one.values() for one in terms[1:]], gain])
    for name, params in (
            ('levels', {'rate_up': 4.0, 'rate_down': 5.0, 'level': -0.3, 'sigma_ratio': 1.0,
                        'at_once': 1.0, 'states': 2.0}),
            ('three', {'rate_up': 4.0, 'rate_down': 5.0, 'level': 0.0, 'sigma_ratio': 2.5,
                       'at_once': 1.0, 'states': 3.0})):
        samples = samples_of(2500, term('regime_switching', **params), seed=152)
        view = view_at(samples, share=0.8)
        fit = (SwitchingLevels if params['level'] else RegimeSwitching).fit_law(view)
        again = fit.term.refit_law(view)
        found[name] = table([fit.term.values(), fit.se, float(fit.gain.sum()), fit.z[::300],
                             again.term.values(), float(again.gain.sum()),
                             fit.term.holds(view)])
    return found


RUNS = {run.__name__: run for run in (flags, stamps, chains, latent)}
