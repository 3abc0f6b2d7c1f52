"""
Results of the online parts on made signals, number by number, for golden tables.

Other tests check correctness; these detect any change of a number, even within tolerances: gaps,
lost throttle, clocks that jump, edges, coarse readings.  `scripts/make_golden.py RUN` updates the
table of a run, test/golden/RUN.json.
"""

from dataclasses import fields, is_dataclass

import numpy as np
from ou_monitor import AdaptiveLowPass, AdaptiveNotch, SlidingEstimator, SupplyMonitor
from ou_monitor.online.load.blocks import LoadDelay
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.settings import MonitorSettings
from scipy.signal import lfilter


def table(value):
    """Return records and arrays as plain data, to nine digits."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: table(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        return [table(one) for one in value.tolist()]
    if isinstance(value, (list, tuple)):
        return [table(one) for one in value]
    if isinstance(value, dict):
        return {str(name): table(one) for name, one in value.items()}
    if isinstance(value, str):
        # Sentences have their own tests.
        return '...' if ' ' in value else value
    if isinstance(value, bool) or value is None:
        return value
    if isinstance(value, (int, float, np.number)):
        return float(f'{value:.9g}') if np.isfinite(value) else str(value)
    return str(value)


def _pack(t, u, rng, noise=0.04):
    """Return the voltage, V, of four cells: sag at once, after 60 ms, 2 s; discharge."""
    x, dt = u ** 1.8, np.diff(t, prepend=t[0])
    fast, slow = x.copy(), 0.5 * x
    for k in range(1, t.size):
        fast[k] = x[k] + (fast[k - 1] - x[k]) * np.exp(-dt[k] / 0.06)
        slow[k] = x[k] + (slow[k - 1] - x[k]) * np.exp(-dt[k] / 2.0)
    return (16.2 - 0.004 * np.cumsum(x * dt) - 0.6 * x - 0.9 * fast - 0.5 * slow
            + noise * rng.standard_normal(t.size))


def _sticks(t, rng, pace):
    return np.clip(0.4 + 0.25 * rng.standard_normal(2 + int((t[-1] - t[0]) * pace)), 0.0, 1.0)[
        ((t - t[0]) * pace).astype(int)]


def load():
    """Return states of the load filter after each part of a flight with all kinds of events."""
    rng = np.random.default_rng(31)
    loads, found, ends = LoadFilter(), [], [-np.inf]

    def part(t, u, offset=0.0, step=0.0, current=None):
        v = _pack(t, np.where(np.isfinite(u), u, 0.4), rng) + offset
        v = step * np.round(v / step) if step else v
        drawn = np.full(t.size, np.nan) if current is None else current
        if t[0] < ends[-1]:
            loads.new_time_line()
        ends.append(t[-1])
        # After the first few samples, when little is known.
        for n in (0, 1, 2, 4, 9):
            some = slice(n, max(2 * n, 1))
            loads.push(t[some], v[some], u[some], drawn[some])
            early = loads.state()
            found.append([] if early is None else table([
                early.mean[:2], np.sqrt(np.diag(early.covariance))[:4], early.log_variance[0],
                loads.load().resistance, loads.load().status.name]))
        loads.push(t[18:], v[18:], u[18:], drawn[18:])
        ahead = t[-1] + np.array([0.01, 0.1, 1.0, 5.0, 30.0])
        state = loads.state()
        one = loads.load()
        found.append(table({
            'load': one, 'sag': one.sag([0.1, 0.5, 1.0]), 'noise': one.noise([0.1, 0.6, 1.0]),
            'path': loads.path(ahead, np.array([0.2, 0.9, 0.9, 0.3, 0.5])),
            'state': None if state is None else {
                'mean': state.mean, 'errors': np.sqrt(np.diag(state.covariance)),
                'rest': [*state.lags, state.size, state.fall, *state.log_variance,
                         *state.flown]}, 'learned': loads.learned()}))
        for name in ('_sag', '_sag_se'):
            found[-1]['load'].pop(name)

    t = np.arange(0.0, 12.0, 0.02)
    part(t, _sticks(t, rng, 3.0))
    fast = 12.0 + np.arange(0.0, 2.0, 0.001)
    part(fast, _sticks(fast, rng, 9.0))
    # A gap in which the pack recovers, readings of a coarse ADC.
    t = 20.0 + np.arange(0.0, 6.0, 0.02)
    part(t, _sticks(t, rng, 2.0), step=0.05)
    # Throttle lost, and back.
    part(26.0 + np.arange(0.0, 3.0, 0.02), np.full(150, np.nan))
    t = 29.0 + np.arange(0.0, 3.0, 0.02)
    part(t, _sticks(t, rng, 4.0))
    # Another pack, on another clock; then a voltage that jumps in flight; then current.
    part(t - 1000.0, _sticks(t, rng, 4.0), offset=-0.6)
    part(t - 997.0, _sticks(t, rng, 4.0), offset=-2.4)
    u = _sticks(t, rng, 4.0)
    part(t - 994.0, u, current=40.0 * u ** 1.8 + rng.standard_normal(t.size))
    part(t - 991.0, u, current=np.where(t > 30.0, np.nan, 80.0 * u ** 1.8))
    # One sample a second, and a pause of minutes.
    slow = -900.0 + np.arange(0.0, 30.0)
    part(slow, _sticks(slow, rng, 0.5))
    return found


def delays():
    """Return when a delay is found, and when voltage and throttle are judged unrelated."""
    found = {}
    for late in (0.0, 0.06, 0.12, 0.3):
        rng = np.random.default_rng(7)
        t = np.arange(0.0, 25.0, 0.02)
        t[1060:] += 0.2
        u = _sticks(t, rng, 4.0)
        v = _pack(t, u, rng, 0.15)
        heard = u[np.maximum(np.arange(t.size) - round(late / 0.02), 0)] ** 1.8
        delay, taken, related = LoadDelay(), [], []
        for k, one in enumerate(zip(t.tolist(), v.tolist(), heard.tolist())):
            if delay.take(*one):
                taken.append([k, delay.delay])
            related.append(delay.unrelated)
        found[str(late)] = [taken, np.flatnonzero(np.diff(related)).tolist()]
    return found


def flight(rng, n, dt=1e-3):
    """Return an OU of 63 / s about a level that sags with throttle, which steps; stamps."""
    t = np.arange(n) * dt
    u = _sticks(t, rng, 2.0)
    noise = lfilter([1.0], [1.0, -np.exp(-63.0 * dt)],
                    0.632 * np.sqrt(dt) * (1.0 + u) * rng.standard_normal(n))
    return t, 5.0 - 0.3 * u + noise - 1e-3 * t, u


def _slow_flight(rng, n):
    t = np.arange(n) * 0.02
    u = _sticks(t, rng, 1.5)
    return t, _pack(t, u, rng), u


def risk():
    """Return reports and risks of monitors through flights."""
    found = []
    for made, n, level, more in (
            (flight, 9000, 4.55, {}),
            (_slow_flight, 1200, 14.6, {'window': 10.0})):
        t, v, u = made(np.random.default_rng(41), n)
        u[5000:5600] = np.nan
        monitor = SupplyMonitor(MonitorSettings(
            brownout_voltage=level, brownout_horizon=1.0, brownout_budget_limit=0.05,
            **{'window': 2.0, **more}))
        every = 1500 if made is flight else 300
        for k in range(0, n, every):
            for begin in range(k, k + every, 50 if every == 300 else 250):
                part = slice(begin, begin + (50 if every == 300 else 250))
                monitor.push(t[part] + (30.0 if k >= 7500 else 0.0), v[part], u[part])
                report = monitor.report(0.0)
            found.append(table({
                'fields': {name: number(text) for name, text in report.fields.items()},
                'flag': report.flag, 'level': report.level.name,
                'risks': [monitor.risk(level + off, horizon) for off in (-0.25, -0.05, 0.25)
                          for horizon in (0.2, 1.0, 7.0)],
                'if': [monitor.risk_if(throttle, dwell, level, 2.0) for throttle in (0.1, 0.9)
                       for dwell in (0.1, 3.0)]}))
    return found


def number(text):
    try:
        return float(text)
    except ValueError:
        return text


def estimates():
    """Return estimates of windows of all kinds."""
    rng = np.random.default_rng(51)
    t, v, u = flight(rng, 2400)
    noise = rng.standard_normal(t.size)
    some = np.sort(rng.permutation(t.size)[:1700])
    jittered = t + 2e-4 * rng.standard_normal(t.size)
    late = t.copy()
    late[1000:1040] -= 0.5
    clipped = np.minimum(v, 4.95)
    kinds = {
        'plain': (t, v, u), 'no throttle': (t, v, None), 'noisy': (t, v + 0.02 * noise, u),
        'some': (t[some], v[some], u[some]), 'jittered': (jittered, v, u),
        'coarse': (t, 0.06 * np.round(v / 0.06), u), 'clipped': (t, clipped, u),
        'held': (t, np.repeat(v[::4], 4), u), 'uneven held': (t, v[(np.arange(2400) * 3 // 10)
                                                                   * 10 // 3], u),
        'late': (late, v, u), 'drift': (t, v + 0.2 * t ** 2, u), 'slow': (20.0 * t, v, u),
        'white': (t, 5.0 + 0.02 * noise, u), 'walk': (t, 5.0 + 0.003 * np.cumsum(noise), u),
        'short': (t[:70], v[:70], u[:70]), 'holes': (t, np.where(noise > 1.5, np.nan, v), u),
        'rest': (t, v, np.where(t < 1.2, 0.3, np.nan))}
    found = {}
    for name, (stamps, volts, throttle) in kinds.items():
        estimator = SlidingEstimator(1.5 * (stamps[-1] - stamps[0]) / 2.4)
        for begin in range(0, stamps.size, 300):
            part = slice(begin, begin + 300)
            estimator.push(stamps[part], volts[part],
                           None if throttle is None else throttle[part])
            if begin % 900 == 0:
                estimator.estimate()
        e = estimator.estimate()
        found[name] = table(e)
        found[name]['intervals'] = table([e.interval(one) for one in ('alpha', 'sigma')])
    return found


_LAWS = ({'law': 'constant_noise'}, {'law': 'constant_noise', 'coupling': 2.0, 'n0': 1e-3,
                                     'noise_wanted': 0.3},
         {'law': 'threshold'},
         {'law': 'kalman', 'coupling': 2.0},
         {'law': 'kalman', 'coupling': 1.0, 'max_lag': 25.0, 'n0': 1e-3},
         {'law': 'kalman', 'coupling': 1.0, 'max_lag': 10.0})


def filters():
    """Return outputs and states of the filter for every law, order and mode."""
    found = []
    rng = np.random.default_rng(61)
    n = 1500
    t = 1e-3 * np.cumsum(rng.choice([0.9, 1.0, 1.1], n))
    t[900:] += 0.3
    t[1200] = t[1199]
    x = np.sin(9.0 * t) + 0.3 * rng.standard_normal(n)
    x[400] = np.nan
    sigma = np.repeat(rng.uniform(0.1, 1.2, n // 50), 50)
    sigma[700:800] = np.nan
    more = {'sigma_se': 0.1, 'alpha': np.where(t < 0.6, 63.0, 30.0)}
    for law in _LAWS:
        for mode in ('lowpass', 'derivative'):
            for order in (1, 2):
                # Single samples, and arrays of samples.
                one = AdaptiveLowPass(mode=mode, order=order, **law)
                y = [one.filter(t[:700], x[:700], sigma[:700], **{
                    name: value[:700] if np.ndim(value) else value
                    for name, value in more.items()})]
                said = [one.cutoff, one.wanted, one.phase_lag, one.delay]
                one.configure(smoothing=0.05, fmax=120.0)
                for k in range(700, n):
                    y.append([one.step(t[k], x[k], sigma[k], 0.1, float(more['alpha'][k]))])
                y = np.concatenate(y)
                found.append(table({
                    'which': [law, mode, order], 'y': y[99::200], 'said': said,
                    'end': [one.cutoff, one.wanted, one.bound.name, one.phase_lag, one.delay],
                    'counters': one.counters}))
    return found


def notches():
    """Return outputs and frequencies of notches with throttle and with motor speeds."""
    rng = np.random.default_rng(71)
    n = 3000
    t = np.arange(n) * 1e-3
    u = 0.45 + 0.2 * np.sin(2.5 * t) + 0.1 * np.sin(5.8 * t)
    f = 420.0 * np.sqrt(u) - 40.0
    turn = np.cumsum(f) * 2e-3 * np.pi
    x = np.stack((100.0 * np.sin(9.4 * t) + 30.0 * np.sin(turn) + rng.standard_normal(n),
                  20.0 * np.sin(1.1 * turn) + 2.0 * rng.standard_normal(n)), axis=1)
    rpm = 60.0 * np.stack((f, 1.1 * f), axis=1)
    rpm[2500:2600] = np.nan
    found = {}
    for name, more, options in (('throttle', {'throttle': u}, {}),
                                ('motors', {'throttle': u, 'rpm': rpm}, {'count': 2}),
                                ('neither', {}, {})):
        notch = AdaptiveNotch(**options)
        y = []
        for begin in range(0, n, 500):
            part = slice(begin, begin + 500)
            y.append(notch.filter(t[part], x[part], **{
                key: value[part] for key, value in more.items()})[::97])
            y.append([[*notch.law], [notch.rate, notch.delay]])
            found[f'{name} {begin}'] = table([notch.frequencies, notch.source, notch.active,
                                              notch.delays(40.0)])
        found[name] = table(np.concatenate(y))
    return found


RUNS = {run.__name__: run for run in (load, delays, risk, estimates, filters, notches)}
