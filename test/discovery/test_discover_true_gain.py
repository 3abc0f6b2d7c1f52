"""Gains of models by `discover`, against the gain of the true model; and dips."""

import math

import numpy as np
from ou_monitor import discover
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.gain import (
    covered, gain_of, held_out)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
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


@pytest.mark.parametrize('seed', range(4))
def test_parameters_that_the_likelihood_hardly_tells_apart_do_not_hide_a_gain(seed):
    """A high-pass about as fast as the rail: 0.03 nats a sample, 130 in all."""
    t = np.arange(4300) / 109.0
    model = SupplyModel((OU(48.5, 0.18, 4.09), ACCoupling(corner=11.6, offset=4.09)))
    found = discover(Recording(t, model.simulate(t, np.random.default_rng(seed)))).record
    (cause,) = found.causes
    assert cause.name == 'ac_coupling' and cause.gain == pytest.approx(0.03, abs=0.01)
