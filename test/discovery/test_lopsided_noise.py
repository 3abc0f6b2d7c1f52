"""Noise with falls deeper than its rises: its simulation, and where `discover` names it."""

import numpy as np
from ou_monitor import discover
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.decision import kinds_to_try
from ou_monitor.discovery.gain import held_out
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import LopsidedNoise, MeasurementNoise, Quantization
from ou_monitor.records import Recording
import pytest
from scipy.signal import lfilter
from scipy.stats import norm, skew

RAIL, STD = OU(1.0, 0.01, 12.0), 0.05
N, RATE = 6000, 50.0
# Enough to name noise that is there.
FEW = 4000
T = np.arange(N) / RATE


@pytest.mark.parametrize('shape, sign', [((-0.4, 0.9), -1), ((0.3, 0.7), 1), ((0.0, 0.8), 0)])
def test_its_mean_and_deviation_are_those_of_white_noise(shape, sign):
    terms = OU(1.0, 0.0, 0.0), MeasurementNoise(STD), LopsidedNoise(*shape)
    v = SupplyModel(terms).simulate(np.arange(10**5) / RATE, np.random.default_rng(1))
    assert v.mean() == pytest.approx(0.0, abs=4.0 * STD / 300.0)
    assert v.std() == pytest.approx(STD, rel=0.03)
    assert np.sign(np.round(skew(v), 0 if not sign else 2)) == sign


def exact_likelihood(v, ou, std, law, dt):
    """Return the log-likelihood of an OU in lopsided noise, by a filter on a grid."""
    sd = ou.sigma / np.sqrt(2.0 * ou.alpha)
    x = np.linspace(-6.0 * sd, 6.0 * sd, 500)
    keep = np.exp(-ou.alpha * dt)
    move = norm.pdf(x[:, None], keep * x, sd * np.sqrt(1.0 - keep ** 2)) * (x[1] - x[0])
    draws = np.sinh((np.arcsinh(norm.ppf((np.arange(10**5) + 0.5) / 10**5)) + law.skew) / law.tail)
    weight, total = norm.pdf(x, 0.0, sd) * (x[1] - x[0]), 0.0
    for k, one in enumerate(v - ou.u0):
        y = draws.mean() + draws.std() * (one - x) / std
        wide = law.tail * np.arcsinh(y) - law.skew
        weight = (move @ weight if k else weight) * norm.pdf(np.sinh(wide)) * law.tail * np.cosh(
            wide) / np.hypot(1.0, y) * draws.std() / std
        total += np.log(weight.sum())
        weight /= weight.sum()
    return total


@pytest.mark.parametrize('alpha, std, shape', [
    (10.0, 0.02, (0.45, 0.57)), (10.0, 0.006, (0.45, 0.57)), (40.0, 0.013, (0.6, 0.65)),
    (3.0, 0.013, (-0.5, 0.7))])
def test_the_likelihood_is_nearly_that_of_an_exact_filter(alpha, std, shape):
    """At least 0.75 of the gain over normal noise (0.81 to 0.98 in six rails of each kind)."""
    ou, noise, law = OU(alpha, 0.0185 * np.sqrt(2.0 * alpha), 5.0), MeasurementNoise(
        std), LopsidedNoise(*shape)
    t, gains, exact, found = 0.01 * np.arange(2000), 0.0, 0.0, []
    for seed in range(3):
        v = SupplyModel((ou, noise, law)).simulate(t, np.random.default_rng(seed))
        normal, fit = (fit_composite(Samples(t, v, None), terms, slice(0, t.size)) for terms in (
            (ou, noise), (ou, noise, law)))
        gains += float((fit.density - normal.density).sum())
        exact += exact_likelihood(v, ou, std, law, 0.01) - float(normal.density.sum())
        found.append(fit.terms[1].std / std)
    # Eighteen fitted parameters gain 9 nats on average, and 22 with probability 0.001.
    assert 0.75 * exact < gains < exact + 22.0
    # Up to 13 % off in the six rails.
    assert np.mean(found) == pytest.approx(1.0, abs=0.2)


def test_errors_of_predictions_are_those_of_its_own_filter():
    """They are smaller than those of a filter without the errors of readings, on three rails."""
    ou, noise, law = OU(10.0, 0.0827, 5.0), MeasurementNoise(0.02), LopsidedNoise(0.45, 0.57)
    t = 0.01 * np.arange(2000)
    for seed in range(3):
        v = SupplyModel((ou, noise, law)).simulate(t, np.random.default_rng(seed))
        samples = Samples(t, v, None)
        fit = fit_composite(samples, (ou, noise, law), slice(0, t.size))
        other = evaluate(samples, fit.gaussian.terms, fit.events, inside=True)
        assert np.std(held_out(samples, fit).error) < np.std(other.innovation)


def test_the_mean_is_not_drawn_to_the_mode():
    """On eight rails its error is 1.6 times a plain fit's; with raw readings it was 6 times."""
    ou, noise, law = OU(40.0, 0.03, 5.0), MeasurementNoise(0.02), LopsidedNoise(0.45, 0.57)
    t, errors = 0.01 * np.arange(1000), []
    for seed in range(8):
        v = SupplyModel((ou, noise, law)).simulate(t, np.random.default_rng(seed))
        errors.append([fit_composite(Samples(t, v, None), terms, slice(0, t.size)).terms[0].u0
                       - 5.0 for terms in ((ou, noise), (ou, noise, law))])
    plain, own = np.sqrt(np.mean(np.square(errors), axis=0))
    assert own < 3.0 * plain


def test_bursts_of_load_are_named_and_explain_the_recording():
    """Beside a sag under throttle in steps."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.random(N // 50), 50)
    rail = SupplyModel((RAIL,)).simulate(T, rng)
    bursts = -STD * (rng.gamma(2.0, size=N) - 2.0) / np.sqrt(2.0)
    found = discover(Recording(T, rail - 0.8 * u + bursts, u, 'bursts'))
    assert {'load_sag', 'measurement_noise', 'lopsided_noise'} == {c.name for c in found.causes}
    law = next(c.term for c in found.causes if c.name == 'lopsided_noise')
    assert law.skew < -0.2 and abs(next(
        one.after for one in found.criticism if one.statistic == 'skewness')) < 4.0


def test_noise_of_another_asymmetric_law_is_named_and_something_left():
    """Gamma noise: the law is not its own, and takes up seven tenths of its skewness at least."""
    rng = np.random.default_rng(0)
    rail = SupplyModel((OU(5.0, 0.15, 12.0),)).simulate(T, rng)
    noisy = rail + 0.08 * (1.0 - rng.gamma(1.5, 1.0, N) / 1.5)
    found = discover(Recording(T[:FEW], noisy[:FEW]))
    assert 'lopsided_noise' in [cause.name for cause in found.causes]
    (skewness,) = (c for c in found.record.criticism if c.statistic == 'skewness')
    assert abs(skewness.after) < 0.3 * abs(skewness.before)


@pytest.mark.parametrize('of_rail', [False, True])
def test_less_than_half_of_the_noise_is_named_and_an_asymmetric_drive_is_not(of_rail):
    """White noise is two fifths of the one-step variance; or else the drive is asymmetric."""
    named, n = [], N if of_rail else FEW
    for seed in range(3):
        rng = np.random.default_rng(seed)
        falls = (2.0 - rng.gamma(2.0, size=N)) / np.sqrt(2.0)
        even = rng.standard_normal(N)
        kicks, white = (falls, even) if of_rail else (even, falls)
        rail = lfilter([0.05], [1.0, -0.9], kicks)
        found = discover(Recording(T[:n], (12.0 + rail + 0.05 * white)[:n]))
        named.append('lopsided_noise' in {c.name for c in found.causes})
    assert sum(named) == (0 if of_rail else 3)


def test_even_tails_are_not_called_lopsided():
    rng = np.random.default_rng(4)
    noise = STD * rng.laplace(size=N) / np.sqrt(2.0)
    found = discover(Recording(T, SupplyModel((RAIL,)).simulate(T, rng) + noise))
    assert 'lopsided_noise' not in {c.name for c in found.causes}


def test_steps_of_the_adc_alone_are_not_shaped():
    """It is tried beside white noise only: it has none to shape in a rail read in coarse steps."""
    kinds = kinds_to_try(catalogue().values(), [OU, Quantization], (), True, False)
    assert LopsidedNoise not in kinds
    assert LopsidedNoise in kinds_to_try(
        catalogue().values(), [OU, MeasurementNoise], (), True, False)
