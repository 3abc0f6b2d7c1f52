"""Gains of models by `discover`, against the gain of the true model; and dips."""

import math

import numpy as np
from ou_monitor import discover
from ou_monitor.analysis.supply import dip_begins
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.gain import blocks_of, covered, gain_of, held_out
from ou_monitor.discovery.load_effects import low_dips
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.shocks import Jumps
from ou_monitor.model.terms.slow import ACCoupling, Drift, SecondRelaxation
from ou_monitor.model.terms.tones import Tone
from ou_monitor.records import Recording
import pytest

RAIL = OU(63.0, 0.3156, 5.0)
RATE, SECONDS = 500.0, 20.0
# Strengths, and where a fit starts.
KINDS = {
    'load_sag': (LoadSag(0.15, 0.0), LoadSag(0.05, 0.0)),
    'parabola': (LoadSag(0.01, 0.02), LoadSag(0.05, 0.01)),
    'measurement_noise': (MeasurementNoise(0.008), MeasurementNoise(0.004)),
    'load_dependent_sigma': (LoadDependentSigma((0.0, 1.0), (0.0, 0.4)),
                             LoadDependentSigma((0.0, 1.0), (0.0, 0.2))),
    'second_relaxation': (SecondRelaxation(3.0, 0.06), SecondRelaxation(5.0, 0.05)),
    'drift': (Drift(-0.01, 0.0), Drift(-0.005, 0.0)),
    'curved drift': (Drift(-1e-4, -1e-6), Drift(-0.005, 0.0001)),
    'tone': (Tone(0.006, 37.0, 0.3, 0.0), None)}


def simulated(seed, *terms, seconds=SECONDS):
    """Return stamps, throttle in steps of 0.4 s, and a model's voltage."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    hold = round(0.4 * RATE)
    u = np.repeat(rng.random(t.size // hold + 1), hold)[:t.size]
    return Samples(t, SupplyModel((RAIL, *terms)).simulate(t, rng, u), u)


def fitted(samples, start):
    """Return the plain fit and one with a term; a line starts where the spectrum has it."""
    everything = slice(0, samples.n)
    plain = fit_composite(samples, [OU(50.0, 0.3, 5.0)], everything)
    if start is None:
        start = Tone.candidates(view_of(samples, plain.gaussian, plain.z, everything))[0]
    return plain, fit_composite(samples, [OU(60.0, 0.3, 5.0), start], everything)


def true_gain(samples, true, plain_density, scored):
    """Return the gain on the samples scored of the model that made them, nats per sample."""
    density = evaluate(samples, (RAIL, true)).density
    return float((density - plain_density)[scored].mean())


@pytest.fixture(scope='module')
def measured():
    """Return gain, its error, and the true gain: six recordings a kind."""
    found = {}
    for name, (true, start) in KINDS.items():
        rows = []
        for seed in range(6):
            samples = simulated(1000 + seed, true)
            plain, full = (held_out(samples, fit) for fit in fitted(samples, start))
            scored = covered(samples)
            rows.append((*gain_of(full, plain, scored),
                         true_gain(samples, true, plain.density, scored)))
        found[name] = np.array(rows)
    return found


def test_the_gain_is_that_of_the_true_model_less_its_parameters(measured):
    """Three errors in each of 48 recordings, of which chance puts 0.13 beyond."""
    # Six parameters on 10 000 samples cost 6 * 6/5 / (2 * 10 000) nats, and scatter by as much.
    loss = 6 * 6 / 5 / (2 * 10_000)
    z = np.concatenate([(a[:, 0] - a[:, 2]) / np.hypot(a[:, 1], loss) for a in measured.values()])
    assert (np.abs(z) > 3.0).sum() <= 2
    # Nor would a gain counted twice, or with the wrong sign, pass.
    for factor in (2.0, -1.0):
        wrong = np.concatenate([(factor * a[:, 0] - a[:, 2]) / np.hypot(a[:, 1], loss)
                                for a in measured.values()])
        assert (np.abs(wrong) > 3.0).sum() > 2


def test_a_block_kept_back_is_scored_as_by_a_fit_to_the_others():
    """Sag and rail of 5 s: one step of scoring against a fit without the last block."""
    # The fit to everything is better on that block by k/2 (1/6 + 1/5) = 0.73 nats, of four
    # parameters: what it gains there, and what the others lose.
    differences, kept, inside = [], [], []
    for seed in range(12):
        samples = simulated(100 + seed, LoadSag(0.15, 0.0), seconds=5.0)
        start = [OU(60.0, 0.3, 5.0), LoadSag(0.05, 0.0)]
        full = fit_composite(samples, start, slice(0, samples.n))
        block = blocks_of(samples.n)[-1]
        others = fit_composite(samples, start, slice(0, block.start))
        mine = held_out(samples, full).density[block].sum()
        differences.append(mine - others.density[block].sum())
        kept.append(others.density[block].sum())
        inside.append(full.density[block].sum())
    lost = np.array(inside) - np.array(kept)
    error = np.std(lost, ddof=1) / math.sqrt(12)
    assert abs(np.mean(lost) - 0.73) < 4.0 * error < 4.0 * 0.73
    assert np.sqrt(np.mean(np.square(differences))) < 0.25 * np.sqrt(np.mean(np.square(lost)))


def test_the_loss_by_parameters_is_that_of_theory():
    """Sag: mean loss over 40 recordings against half the parameters over the samples fitted."""
    # Four parameters on 10 000 samples, five blocks of six: 2.4e-4 nats. A sum of four squares and
    # what they do to the score spreads by 1.2 times that at most.
    true, start = KINDS['load_sag']
    losses = []
    for seed in range(40):
        samples = simulated(seed, true)
        full = held_out(samples, fitted(samples, start)[1])
        losses.append(float((evaluate(samples, (RAIL, true)).density - full.density).mean()))
    wanted = 4 * 6 / 5 / (2 * 10_000)
    assert abs(np.mean(losses) - wanted) < 4.0 * np.std(losses, ddof=1) / math.sqrt(40)
    # Power: the fit to everything gains as much instead.
    assert np.mean(losses) + wanted > 4.0 * np.std(losses, ddof=1) / math.sqrt(40)


@pytest.mark.parametrize('name', ['load_sag', 'load_dependent_sigma', 'second_relaxation'])
def test_the_gain_reported_is_the_true_models(name):
    """Within three errors of the true model's, over the plain fit that `discover` made."""
    # One of the mean, one of the intensity, one with a state; the gains of all kinds are above.
    true, _ = KINDS[name]
    simulated_of = simulated(2000, true)
    found = discover(Recording(simulated_of.t, simulated_of.voltage, simulated_of.throttle, name))
    samples = found.samples
    assert samples.n == simulated_of.n
    scored = covered(samples)
    plain = held_out(samples, fit_composite(
        samples, [found.baseline], slice(0, samples.n))).density
    assert found.baseline_score == pytest.approx(float(plain[scored].mean()), abs=1e-4)
    assert found.gain == pytest.approx(found.score - found.baseline_score, abs=1e-9)
    loss = 6 * 6 / 5 / (2 * samples.n)
    assert abs(found.gain - true_gain(samples, true, plain, scored)) < 3.0 * math.hypot(
        found.gain_se, loss)
    assert found.gain > 0.0


def late_start(seed=1):
    """Return a recording whose throttle is still until 90 % of it, and then moves."""
    samples = simulated(seed, LoadSag(0.3, 0.0))
    still = round(0.9 * samples.n)
    u = samples.throttle.copy()
    u[:still] = 0.0
    v = samples.voltage + 0.3 * (samples.throttle - u)
    return Samples(samples.t, v, u)


def test_samples_at_throttle_never_fitted_are_not_scored():
    """Throttle that moves in the last block alone: its still samples count, and all others."""
    samples = late_start()
    scored = covered(samples)
    assert scored[samples.throttle == 0.0].all() and not scored[samples.throttle > 0.01].any()
    assert covered(Samples(samples.t, samples.voltage, None)).all()


def test_samples_soon_after_a_punch_of_one_block_are_not_scored():
    """The rail still answers to a throttle that the other blocks have not been through."""
    t = np.arange(6000) / 100.0
    u = 0.3 + 0.1 * np.sin(2.0 * t)
    punch = (t >= 31.0) & (t < 31.5)
    u[punch] = 1.0
    scored = covered(Samples(t, np.zeros(t.size), u))
    assert not scored[punch].any() and not scored[(t >= 31.5) & (t < 31.65)].any()
    assert scored[(t < 31.0) | (t >= 33.0)].all()


def test_a_cause_that_only_one_block_shows_has_no_gain():
    """The sag is seen in the last block only: it cannot be scored there, and why is said."""
    samples = late_start()
    found = discover(Recording(samples.t, samples.voltage, samples.throttle, 'late'))
    assert math.isnan(found.gain) or abs(found.gain) < 0.05
    assert any('the rest of the recording does not cover' in note for note in found.notes)


# A law is fitted from nothing.
CROSSED = {
    'load_sag': (LoadSag(0.15, 0.0), LoadSag(0.05, 0.0)),
    'load_dependent_sigma': (LoadDependentSigma((0.0, 1.0), (0.0, 1.2)),
                             LoadDependentSigma((0.0, 1.0), (0.0, 0.5))),
    'jumps': (Jumps(2.0, -0.1, 0.03), Jumps)}


@pytest.mark.parametrize('name', sorted(CROSSED))
def test_the_extended_model_dips_as_often_as_the_data(name):
    """Eight recordings: summed over them, extended minus observed within errors."""
    # Dips come in clusters, for one is followed by others while the rail stays near the
    # level: their number spreads by more than that of independent ones. By how much is measured
    # here, on simulations of the true model, and enters the tolerance of 3.5 errors. The plain OU
    # has to be off by more.
    true, start = CROSSED[name]
    rows = []
    for seed in range(8):
        samples = simulated(500 + seed, true)
        plain, full = fitted(samples, start)
        rise = np.zeros(samples.n)
        rates = low_dips(samples, rise, plain.terms, full.terms, np.random.default_rng(seed))
        rows.append((rates.observed, rates.baseline, rates.extended))
        drawn = [60.0 / np.ptp(samples.t) * dip_begins(SupplyModel((RAIL, true)).simulate(
            samples.t, np.random.default_rng([seed, k]), samples.throttle), rates.level, rise).size
            for k in range(12)]
        rows[-1] += (float(np.std(drawn, ddof=1)),)
    observed, baseline, extended, spread = np.array(rows).T
    # Averages of eight simulations, and parameters known from the first part.
    error = math.sqrt(float((spread**2).sum()) * (1.0 + 1.0 / 8 + 1.0 / 1.5)) / 8
    assert abs(np.mean(extended - observed)) < 3.5 * error
    assert abs(np.mean(baseline - observed)) > 3.5 * error


@pytest.mark.parametrize('seed', range(4))
def test_parameters_that_the_likelihood_hardly_tells_apart_do_not_hide_a_gain(seed):
    """A high-pass about as fast as the rail: 0.03 nats a sample, 130 in all."""
    t = np.arange(4300) / 109.0
    model = SupplyModel((OU(48.5, 0.18, 4.09), ACCoupling(corner=11.6, offset=4.09)))
    found = discover(Recording(t, model.simulate(t, np.random.default_rng(seed)))).record
    (cause,) = found.causes
    assert cause.name == 'ac_coupling' and cause.gain == pytest.approx(0.03, abs=0.01)
