"""NumPy and Numba give the same; without Numba nothing is missing."""

import importlib.util
import json
import math
import os
import subprocess
import sys
import types

import numpy as np
from ou_monitor.model import arma
from ou_monitor.online.estimator import compiled
import pytest

HAVE_NUMBA = importlib.util.find_spec('numba') is not None
# Clean, noisy, with throttle, with a gap, as block means that are noisy or clean, with
# throttle too, and with noise so strong that coarser means are used; slid, with estimates
# on the way.
SCRIPT = """
import json, sys
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.model.ou import simulate
from ou_monitor.online.estimator.compiled import kernels
have = kernels(wait=True) is not None
rng = np.random.default_rng(1)
t = np.arange(5000) * 1e-3
u = 0.2 + 0.5 * (np.floor(t / 0.3) % 2)
gap = (t < 2.5) | (t > 2.9)
out = []
for noise, loaded, gaps, fastest in (
        (0.0, False, False, 1e4), (5e-3, False, False, 1e4), (5e-3, True, False, 1e4),
        (5e-3, False, True, 1e4), (5e-3, False, False, 200.0), (0.0, False, False, 200.0),
        (0.0, True, False, 1e4), (5e-3, True, False, 200.0), (0.03, False, False, 1e4)):
    y = simulate(t, 63.0, 0.632, rng, u0=5.0) + noise * rng.standard_normal(5000)
    y -= 0.6 * u * loaded
    use = gap if gaps else t >= 0.0
    s, v, w = t[use], y[use], u[use]
    for looks in (False, True):
        e = SlidingEstimator(2.0, fastest=fastest)
        for begin in range(0, s.size, 500):
            part = slice(begin, begin + 500)
            e.push(s[part], v[part], w[part] if loaded else None)
            if looks:
                e.estimate()
        f = e.estimate()
        out.append([f.alpha, f.sigma, f.var_inf, f.u0, f.noise_std, f.alpha_se, f.sigma_se,
                    f.var_inf_se, f.u0_se, f.n, f.counters.used, f.status.name])
print(json.dumps([have, out]))
"""


def run(setting):
    """Return whether kernels were there, and the estimates of the script."""
    done = subprocess.run([sys.executable, '-c', SCRIPT], capture_output=True, text=True,
                          check=True, env={**os.environ, 'OU_MONITOR_COMPILED': setting,
                                           'PYTHONPATH': os.pathsep.join(sys.path)})
    have, out = json.loads(done.stdout)
    return have, out


def test_numpy_and_numba_agree():
    """
    Estimates to 1e-9, whether noise was found or not, throttle moves or not.

    Sums differ by their rounding, 1e-13, and the search ends where the gradient
    is rounding.  Without Numba both runs are NumPy, and say only that runs repeat.
    """
    plain, numpy_only = run('0')
    fast, both = run('1')
    assert plain is False and fast is HAVE_NUMBA
    assert len(numpy_only) == 18
    # Both kinds of end are among them: no noise, and noise.
    assert len({one[4] > 0.0 for one in numpy_only}) == 2
    for number, (one, two) in enumerate(zip(numpy_only, both)):
        assert one[-1] == two[-1] == 'OK'
        assert one[:-1] == pytest.approx(two[:-1], rel=1e-9, abs=1e-13), number


def test_switch(monkeypatch):
    """OU_MONITOR_COMPILED=0 keeps to NumPy, whatever is installed."""
    monkeypatch.setenv('OU_MONITOR_COMPILED', '0')
    assert compiled.wanted() is False
    monkeypatch.setattr(compiled, 'COMPILED', compiled.Compilation())
    assert compiled.kernels(wait=True) is None
    monkeypatch.delenv('OU_MONITOR_COMPILED')
    assert compiled.wanted() is HAVE_NUMBA


def test_a_compiler_that_fails_is_said_and_done_without(monkeypatch, caplog):
    """A warning, no exception, and NumPy does the work."""
    def broken():
        raise RuntimeError('no LLVM today')

    monkeypatch.setattr(compiled, 'COMPILED', compiled.Compilation())
    monkeypatch.setattr(compiled, 'build', broken)
    monkeypatch.setattr(compiled, 'wanted', lambda: True)
    assert compiled.kernels(wait=True) is None
    assert 'no LLVM today' in caplog.text


def check_kernel():
    """Return the compiled check, or its own text where there is no Numba."""
    fast = compiled.kernels(wait=True)
    assert (fast is None) == (not compiled.wanted())
    return fast.check if fast else compiled.check


@pytest.mark.parametrize('change, good', [
    (lambda t, y: None, True),
    (lambda t, y: y.__setitem__(5, math.nan), False),
    (lambda t, y: y.__setitem__(9, math.inf), False),
    (lambda t, y: t.__setitem__(5, math.nan), False),
    (lambda t, y: t.__setitem__(5, t[4]), False),
    (lambda t, y: t.__setitem__(slice(5, None), t[5:] + 0.01), False),
    (lambda t, y: t.__iadd__(0.01), False)])
def test_check(change, good):
    """Anything that is not finite, even and next to what came before is looked at closely."""
    t, y = np.arange(1, 11) * 1e-3, np.linspace(4.0, 5.0, 10)
    change(t, y)
    assert bool(check_kernel()(t, y, 0.0, 0.5e-3, 1.5e-3)) is good


def test_loops_are_the_text_of_the_kernel():
    """The text of `slot_sums` in plain Python gives what matrices give."""
    rng = np.random.default_rng(4)
    lags, n = 3, 12
    z = rng.standard_normal((2, lags + n))
    runs = np.array([3, 3, 0, 1, 2, 3, 3, 3, 3, 3, 3, 3])
    width = 1 + 2 * 2 + 4 + lags * (1 + 2 + 4)
    rows = np.empty((2, width))
    compiled.slot_sums(z, runs, np.array([0, 5, 12]), lags, rows)
    own = z[:, lags:]
    assert rows[:, 0].tolist() == [5.0, 7.0]
    assert rows[1, 1:3] == pytest.approx(own[:, 5:].sum(axis=1))
    assert rows[1, 3:5] == pytest.approx(own[:, 5:] @ np.arange(7.0))
    assert rows[1, 5:9] == pytest.approx((own[:, 5:] @ own[:, 5:].T).ravel())
    assert rows[0, 9:12].tolist() == [4.0, 3.0, 2.0]
    valid = (runs[:5] >= 2)
    d = (own[:, :5] - z[:, 1:6]) * valid
    assert rows[0, 14:16] == pytest.approx(d.sum(axis=1))
    assert rows[0, 22:26] == pytest.approx((d @ d.T).ravel())


def test_scalar_fit_is_the_same_text():
    """Compiled from their own source; to 1e-12, as only the order of a sum may differ."""
    fast = compiled.kernels(wait=True)
    c = 0.01 * 0.94 ** np.arange(1, 25)
    pairs = np.full(24, 1976.0)
    row = np.concatenate([[2000.0, 3.0, 3100.0, 22.0], pairs, np.full(24, 0.01),
                          2.0 * pairs * (0.011 - c)])
    for m in (1, 10):
        for start in ((math.nan, math.nan), (-2.5, 0.2)):
            one = arma.fit_sums(row.tolist(), 24, *start, m)
            two = fast.fit_sums(row, 24, *start, m) if fast else arma.fit_sums(
                row, 24, *start, m)
            assert tuple(two) == pytest.approx(one, rel=1e-9)
            assert one[1] == pytest.approx(0.011, rel=1e-3) and one[2] > 0.0


@pytest.mark.parametrize('size', [1, 5])
def test_the_first_calls_have_rows_of_the_width_that_is_used(monkeypatch, size):
    """
    Compiled code writes past a row that is too narrow, unnoticed; as Python it would raise.

    A row over two lags of c columns: count, sums, places, products of columns, and for each
    lag pairs, changes and products of changes.
    """
    calls = []

    def recorded(function):
        def call(*arguments):
            calls.append((function.__name__, arguments))
            return function(*arguments)
        return call

    numba, extending = types.ModuleType('numba'), types.ModuleType('numba.extending')
    numba.njit = lambda function=None, **_: recorded(function) if function else recorded
    extending.register_jitable = lambda function=None, **_: function or (lambda given: given)
    numba.extending = extending
    monkeypatch.setitem(sys.modules, 'numba', numba)
    monkeypatch.setitem(sys.modules, 'numba.extending', extending)
    compiled.build()
    # Once each, and the sums once for the voltage alone and once with the throttle.
    assert sorted(name for name, _ in calls) == [
        'add_slots', 'add_slots', 'check', 'finish', 'fit_sums', 'search', 'slide', 'take_slots',
        'take_slots']
    width = sum((1, size, size, size * size, 2, 2 * size, 2 * size * size))
    taken = {given[0].shape[0]: given for name, given in calls if name == 'take_slots'}
    assert taken[size][7] == 2 and taken[size][8].shape[1] == width
    assert width in {given[0].shape[1] for name, given in calls if name == 'add_slots'}
    (slid,) = [given for name, given in calls if name == 'slide']
    assert slid[10] == 2 and slid[11].shape[1] == 10


@pytest.mark.parametrize('seed', range(4))
def test_the_text_of_the_kernels_is_that_of_their_twins(monkeypatch, seed):
    """
    The loops as Python runs them, where NumPy sums: estimates on the way, to 1e-5.

    Gaps, throttle that moves, slots that are open, windows that slide and bad samples.
    """
    from ou_monitor import SlidingEstimator
    rng = np.random.default_rng(seed)
    t = np.arange(900) * 2e-3
    u = 0.2 + 0.5 * (np.floor(t / 0.3) % 2)
    y = 5.0 + 0.05 * np.sin(9.0 * t) + 0.02 * np.cumsum(rng.standard_normal(900)) / 5.0
    if seed == 1:
        t[400:] += 0.15
        y[700] = math.nan
    y -= 0.3 * u * (seed == 2)
    plain = SlidingEstimator(0.8 if seed < 3 else 5.0)
    looped = SlidingEstimator(0.8 if seed < 3 else 5.0)
    kernels = compiled.Kernels(arma.fit_sums, arma.search, arma.finish, compiled.take_slots,
                               compiled.add_slots, compiled.slide, compiled.check)
    start = 0
    while start < t.size:
        stop = start + int(rng.integers(1, 90))
        part = slice(start, stop)
        found = []
        for one, ready in ((plain, None), (looped, kernels)):
            monkeypatch.setattr(compiled.COMPILED, 'ready', ready)
            one.push(t[part], y[part], u[part] if seed == 2 else None)
            e = one.estimate()
            found.append([e.alpha, e.sigma, e.var_inf, e.u0, e.noise_std, e.alpha_se, e.sigma_se,
                          e.u0_se, e.n, e.counters.used, e.t])
            assert one.counters == plain.counters
        assert found[1] == pytest.approx(found[0], rel=1e-5, abs=1e-9, nan_ok=True)
        start = stop


@pytest.mark.parametrize('change, good', [
    (None, True), (('t', 3, 1e-4), False), (('t', 0, -1e-2), False), (('t', 5, -1e-4), False),
    (('y', 2, math.nan), False), (('y', 0, math.inf), False), (('y', 9, -math.inf), False),
    (('y', 4, compiled.LARGEST), True)])
def test_even_and_finite_samples(change, good):
    """Each step within its bounds, the first to the sample before; infinity is not finite."""
    t, y = 1.0 + np.arange(10) * 1e-3, np.zeros(10)
    if change is not None:
        name, k, by = change
        if name == 't':
            t[k] += by
        else:
            y[k] = by
    assert compiled.check(t, y, 1.0 - 1e-3, 0.95e-3, 1.05e-3) == good
    # The bounds belong to what is even.
    whole = np.array([1.0, 2.0, 3.0])
    assert compiled.check(whole, np.zeros(3), 0.0, 1.0, 2.0)
    assert compiled.check(whole, np.zeros(3), 0.0, 0.5, 1.0)
    assert not compiled.check(whole, np.zeros(3), 0.0, 1.5, 2.0)
