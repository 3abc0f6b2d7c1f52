"""Effects that a fit near the plain OU does not see: fast, large, or both at once."""

import math

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import fit_gaussian
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentAlpha, LoadSag
from ou_monitor.model.terms.ou import NonlinearRestoring, OU
from ou_monitor.model.terms.reading import ClockJitter, MeasurementNoise
from ou_monitor.model.terms.regime_switching import SwitchingLevels
from ou_monitor.model.terms.shocks import Glitches
from ou_monitor.model.terms.term import View
from ou_monitor.model.terms.tones import order_lines
import pytest
from scipy.signal import lfilter

# Of a score of independent samples, by chance once in 15000.
FAR = 4.0


def rail(rng, n, alpha, rate, std, mean=0.0):
    """Return an OU, V, that relaxes to a mean which may change from sample to sample."""
    phi = math.exp(-alpha / rate)
    e = std * math.sqrt(1.0 - phi * phi) * rng.standard_normal(n)
    return lfilter([1.0], [1.0, -phi], (1.0 - phi) * mean + e)


def score(a, b):
    a, b = a - a.mean(), b - b.mean()
    return math.sqrt(a.size) * float(a @ b) / math.sqrt(float(a @ a) * float(b @ b))


def test_a_line_that_sweeps_40_bins_in_a_segment_is_found():
    """600 Hz/s: within 0.25 s the line crosses 40 bins of 4 Hz."""
    rng, n, rate = np.random.default_rng(1), 20000, 1000.0
    at = np.arange(n) / rate
    throttle = 0.5 + 0.4 * np.sin(2.0 * math.pi * 0.8 * at)
    turns = np.cumsum(30.0 + 300.0 * throttle) / rate
    z = rng.standard_normal(n) + 0.8 * np.sin(2.0 * math.pi * turns)
    ones = np.ones(n)
    view = View(z=z, variance=ones, phi=ones, state=z, residual=z, at=at, step=ones / rate,
                throttle=throttle, train=slice(0, n))
    idle, slope = order_lines(view)[0]
    # What 20 s can tell: a turn in the whole recording is 0.05 Hz.
    assert abs(slope) == pytest.approx(300.0, abs=1.0)
    assert math.copysign(idle, idle * slope) == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize('share, size', [(0.003, 30.0), (0.02, 10.0), (0.05, 50.0)])
def test_bad_samples_are_named_although_they_are_most_of_the_variance(share, size):
    """White noise first takes up their variance; size in errors of a step."""
    std = size * 0.3 * math.sqrt(1.0 / 500.0)
    t = np.arange(10000) / 500.0
    model = SupplyModel((OU(30.0, 0.3, 14.0), MeasurementNoise(0.002), Glitches(share, std)))
    voltage = model.simulate(t, np.random.default_rng(6))
    names = [cause.name for cause in discover(Recording(t, voltage, np.nan)).causes]
    assert set(names) - {'measurement_noise'} == {'glitches'}


def test_errors_of_readings_hardly_larger_than_the_noise_are_named():
    """One in fifty, of two errors of a step; on average 80 nats, 40 at least in nine of ten."""
    t = np.arange(10_000) / 200.0
    model = SupplyModel((OU(46.0, 0.07, 4.0), MeasurementNoise(0.0033), Glitches(0.02, 0.0106)))
    named = [{cause.name for cause in discover(
        Recording(t, model.simulate(t, np.random.default_rng(seed)), None)).causes}
             for seed in range(4)]
    assert sum('glitches' in one for one in named) >= 3
    assert not any('volatility' in one for one in named)


def test_few_jumps_are_named_as_jumps():
    """Fourteen in all, most of them later than the part to which the search fits."""
    # One jump of some one-step deviations in the fitted part gives share and size; the others
    # are scored with these.  A single one cannot show a mean size.
    rng = np.random.default_rng(6)
    n, phi = 4800, 0.77
    named = []
    for _ in range(6):
        push = rng.standard_normal(n)
        early, late = rng.integers(100, int(0.6 * n), 1), rng.integers(int(0.6 * n), n, 13)
        push[early] = 8.0 * rng.choice([-1.0, 1.0])
        push[late] += 12.0 * rng.standard_normal(late.size)
        v = 23.0 + 0.014 * lfilter([1.0], [1.0, -phi], push)
        named.append({cause.name for cause in discover(
            Recording(np.arange(n) / 62.5, v, None)).causes})
    assert sum('jumps' in one for one in named) >= 5
    assert not any('heavy_tails' in one for one in named)


@pytest.mark.parametrize('slope', [-2.0, 2.0])
def test_a_relaxation_that_changes_under_load_has_one_name_if_var_inf_stays(slope):
    """Sigma follows alpha then, which is one cause, not noise that follows throttle as well."""
    t = np.arange(8000) / 100.0
    u = 0.5 + 0.4 * np.sign(np.sin(2.0 * np.pi * t / 8.0))
    model = SupplyModel((OU(12.0, 0.1, 11.0), LoadDependentAlpha(slope, 0.5 * slope),
                         MeasurementNoise(0.008)))
    found = [discover(Recording(t, model.simulate(t, np.random.default_rng(seed), u), u))
             for seed in range(4)]
    named = [{cause.name for cause in one.causes} for one in found]
    # Law and white noise gain 450 to 700 nats.
    assert sum(one == {'load_dependent_alpha', 'measurement_noise'} for one in named) >= 3
    law = next(cause.term for cause in found[0].causes if cause.name == 'load_dependent_alpha')
    assert law.slope == pytest.approx(slope, abs=0.7)
    assert law.sigma_slope == pytest.approx(0.5 * slope, abs=0.3)


def test_a_lagged_sag_under_jittering_throttle_is_found():
    """Throttle trembles: a sag at once explains nothing, and neither does a lag without it."""
    rng, n, rate = np.random.default_rng(2), 15000, 1000.0
    throttle = 0.5 + rail(rng, n, 2.0, rate, 0.2)
    voltage = 12.0 + rail(rng, n, 30.0, rate, 0.015, -0.1 * throttle)
    finding = discover(Recording(np.arange(n) / rate, voltage, throttle))
    assert [cause.name for cause in finding.causes] == ['load_sag', 'load_transient']
    sag, transient = (cause.term for cause in finding.causes)
    assert sag.linear == pytest.approx(0.1, rel=0.15)
    # All of the sag comes late, at the rate of the rail.
    assert transient.gain == pytest.approx(sag.linear, rel=0.1)
    assert transient.tau == pytest.approx(1.0 / 30.0, rel=0.3)


def test_a_shrinking_sag_is_measured_and_simulated():
    """Within the errors given, and simulated by the model that is saved."""
    rng, n, rate = np.random.default_rng(5), 12000, 200.0
    throttle = 0.5 + rail(rng, n, 2.0, rate, 0.15)
    made = SupplyModel((OU(6.0, 0.2, 16.0), LoadSag(1.4, 0.5, -0.01)))
    t = np.arange(n) / rate
    finding = discover(Recording(t, made.simulate(t, rng, throttle), throttle))
    assert [cause.name for cause in finding.causes] == ['load_sag']
    (cause,) = finding.causes
    for name, value in made.terms[1].values().items():
        assert abs(getattr(cause.term, name) - value) < 4.0 * cause.se[name] < 0.5
    assert cause.term.growth < -10.0 * cause.se['growth']
    assert 'growth = -0.010' in cause.explanation.text and finding.model.terms[1] == cause.term


def test_switching_between_large_levels_is_found():
    """With levels of 6 deviations the plain OU seems to relax at the rate of the switching."""
    rng, n, rate, alpha, std = np.random.default_rng(3), 40000, 2000.0, 180.0, 0.046
    turns = np.cumsum(rng.random(n) < 1.5 / rate)
    voltage = 5.0 + rail(rng, n, alpha, rate, std) - 0.26 * (turns % 2)
    samples = Samples(np.arange(n) / rate, voltage, None)
    plain = fit_gaussian(samples, [OU(60.0, 0.8, 5.0)], samples.train).terms[0]
    assert plain.alpha < 0.3 * alpha
    simulated = fit_composite(samples, [plain, SwitchingLevels], samples.train)
    ou, switching = simulated.terms
    # Of 12 s, alpha is known to sqrt(2 / (alpha T)) = 3 %.
    assert ou.alpha == pytest.approx(alpha, rel=0.12)
    assert abs(switching.level) == pytest.approx(0.26, rel=0.05)
    assert switching.sigma_ratio == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('law, alpha', [
    (ClockJitter(4e-4), 600.0), (NonlinearRestoring(0.0, 6e4), 150.0)])
def test_laws_are_fitted_where_steps_are_long(law, alpha):
    """The pull back changes within a step, or with its length: so do mean and spread."""
    n, rate = 60000, 1000.0
    terms = OU(alpha, 0.8, 5.0), law
    t = np.arange(n) / rate
    samples = Samples(t, SupplyModel(terms).simulate(t, np.random.default_rng(4)), None)
    whole = slice(0, n)
    plain = fit_gaussian(samples, [terms[0]], whole)
    simulated = fit_composite(samples, [plain.terms[0], type(law)], whole)
    state = view_of(samples, plain, plain.z, whole).state
    square = np.clip(state / state.std(), -4.0, 4.0)**2
    assert abs(score(plain.z[1:]**2, square[1:])) > 1.5 * FAR
    assert abs(score(simulated.z[1:]**2, square[1:])) < FAR
    assert abs(score(simulated.z[1:], state[1:]**3)) < FAR


@pytest.mark.parametrize('noise', [0.0, 0.01])
def test_jitter_that_only_a_line_shows_is_named(noise):
    """Errors of the stamps look like white noise, but only where the line is steep."""
    rng, n, rate, std = np.random.default_rng(8), 9000, 150.0, 5e-4
    t = np.arange(n) / rate
    true = t + std * rng.standard_normal(n)
    voltage = (5.0 + rail(rng, n, 20.0, rate, 0.02) + noise * rng.standard_normal(n)
               + 0.3 * np.sin(2.0 * np.pi * 17.3 * true))
    finding = discover(Recording(t, voltage, None))
    found = {cause.name: cause.term for cause in finding.causes}
    assert set(found) == {'tone', 'clock_jitter', *(('measurement_noise',) if noise else ())}
    # 9000 squares, half of them informative: 2 % by chance.
    assert found['clock_jitter'].std == pytest.approx(std, rel=0.08)
