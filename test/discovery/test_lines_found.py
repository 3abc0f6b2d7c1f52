"""Lines that `discover` names: all lines of the supply, whatever else is left, and no others."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor import discover
from ou_monitor.analysis.level_result import fit_level
from ou_monitor.analysis.levels import LoadLevel
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import fitting
from ou_monitor.discovery.fitting import Fitter, standard_errors
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.shocks import HeavyTails
from ou_monitor.model.terms.slow import SecondRelaxation
from ou_monitor.model.terms.tones import Resonance, ThrottleTone, Tone
from ou_monitor.records import NAN, Recording
from project import needs_recordings, REAL, recorded
import pytest
from simulated_recordings import bare

RATE = 50.0
T = np.arange(2000) / RATE
RAIL = OU(20.0, 0.1, 15.0)


def voltage(*terms, throttle=None, seed=0):
    """Return a rail with terms on it, V."""
    return SupplyModel((RAIL, *terms)).simulate(T, np.random.default_rng(seed), throttle)


def test_errors_of_a_singular_filter_are_infinite(monkeypatch):
    """Half of a recorded flight led to such a model, and the whole command ended."""
    samples = Samples(T, voltage(Tone(0.02, 13.0, 0.5, 0.0)), None)
    whole = fit_composite(samples, [RAIL, Tone(0.0, 13.0, 0.0, 0.0)], slice(0, samples.n))

    def singular(*_, **__):
        raise ValueError('the covariance of the model is singular or not finite')

    monkeypatch.setattr(fitting, 'whitened', singular)
    assert standard_errors(samples, whole)[1] == {
        'amplitude': math.inf, 'phase': math.inf}


@pytest.mark.parametrize('damping, rings', [(2.0, True), (60.0, False)])
def test_ringing_that_dies_out_before_it_turns_is_something_else(damping, rings):
    """5 Hz turn in 0.2 s: a damping of 2 /s lets it ring, 60 /s do not."""
    samples = Samples(T, voltage(), None)
    terms = (RAIL, Resonance(5.0, damping, 0.02, 0.0))
    gaussian = evaluate(samples, terms)
    whole = Composite(terms, ({}, {}), gaussian, gaussian.z, gaussian.density, 6, 0.0)
    assert terms[1].holds(Fitter(samples).view(whole)) is rings


@pytest.mark.parametrize('seed', range(3))
def test_a_line_many_widths_wide_is_a_tone_in_spite_of_outliers(seed):
    """A line 9 Hz wide turns its phase eight times in 0.9 s, so no pure tone fits it."""
    # Eight turns determine the logarithm of the width to 1/sqrt(8), with three errors to 1.06.
    t = np.arange(900) / 1000.0
    model = SupplyModel((OU(9650.0, 14.3, 4.1), Tone(0.2, 241.4, 0.0, 9.0), HeavyTails(2.9)))
    found = discover(Recording(t, model.simulate(t, np.random.default_rng(seed))))
    lines = [cause.term for cause in found.causes if cause.name in ('tone', 'resonance')]
    assert [type(line) for line in lines] == [Tone]
    assert abs(np.log(lines[0].linewidth / 9.0)) < 1.06


@pytest.mark.parametrize('frequency, terms, line', [
    (0.4, (LoadSag(1.0, 0.0),), False),
    (0.25, (LoadSag(0.8, 0.6), LoadTransient(0.3, 1.0, 0.0)), True),
    (1.1, (LoadSag(1.0, 0.0), LoadTransient(0.5, 0.3, 0.0)), True)])
def test_periodic_flying_is_not_a_line(frequency, terms, line):
    """Circles flown at some tenths of a hertz move throttle, and that the rail."""
    rng = np.random.default_rng(1)
    hold = np.repeat(rng.standard_normal(T.size // 5), 5)
    throttle = 0.5 + 0.2 * np.sin(2.0 * np.pi * frequency * T) + 0.02 * hold
    tones = (Tone(0.05, 13.0, 0.0, 0.0),) if line else ()
    found = discover(Recording(T, voltage(*terms, *tones, throttle=throttle), throttle, 'path'))
    assert [cause.term.frequency for cause in found.causes if cause.name == 'tone'] == (
        [pytest.approx(13.0, abs=0.01)] if line else [])
    assert {'load_sag', 'load_transient'} & {cause.name for cause in found.causes}


@needs_recordings
def test_analyze_and_discover_name_the_same_lines_of_a_comb():
    """A second of xt_pico_a, a comb of 106.5 Hz: each clear line of one is one of the other."""
    whole = recorded(REAL / 'xt_pico_a.csv')
    n = 5_000
    part = replace(whole, t=whole.t[:n], voltage=whole.voltage[:n], throttle=np.full(n, NAN))
    level = fit_level(part, bare(part), LoadLevel(NAN, (slice(0, n),)), 1)
    tones = [cause for cause in discover(part).causes if cause.name == 'tone']
    ours = [(line.frequency, line.p_value < 1e-5) for line in level.lines.lines]
    theirs = [(one.term.frequency, one.term.amplitude > 7.0 * one.se['amplitude'])
              for one in tones]
    # Two bins.
    for some, others in ((ours, theirs), (theirs, ours)):
        assert sum(clear for _, clear in some) >= 5
        for frequency, clear in some:
            assert not clear or any(abs(frequency - other) < 2.0 for other, _ in others), frequency


def test_white_noise_that_a_line_hid_is_no_second_relaxation():
    """Tried before the line, in vain, it was never tried again: a relaxation within a step won."""
    rng, t = np.random.default_rng(404), np.arange(40000) / 2000.0
    v = SupplyModel((OU(120.0, 0.35, 12.03), Tone(0.008, 317.0, 0.3, 0.0), MeasurementNoise(0.003)
                     )).simulate(t, rng)
    found = {cause.name: cause.term for cause in discover(Recording(t, v)).causes}
    assert set(found) == {'tone', 'measurement_noise'}
    assert abs(found['measurement_noise'].std - 0.003) < 3e-4


@pytest.mark.parametrize('alpha, relaxes', [(0.05, False), (10.0, True), (200.0, False)])
def test_a_relaxation_is_seen_neither_within_a_step_nor_beyond_the_end(alpha, relaxes):
    """The recording lasts 40 s, a step 20 ms."""
    samples = Samples(T, voltage(), None)
    gaussian = evaluate(samples, (RAIL,))
    whole = Composite((RAIL,), ({},), gaussian, gaussian.z, gaussian.density, 3, 0.0)
    assert SecondRelaxation(alpha, 0.1).holds(Fitter(samples).view(whole)) is relaxes


@pytest.mark.parametrize('idle, slope', [(33.0, 60.0), (120.0, -70.0)])
def test_a_weak_line_that_follows_throttle_is_found(idle, slope):
    """60 nats in 20 s: under the noise of each second, above it in all of them together."""
    rng, n, rate = np.random.default_rng(4), 6000, 300.0
    t = np.arange(n) / rate
    throttle = 0.5 + 0.15 * np.sin(1.9 * t) + 0.2 * np.sin(0.7 * t + 1.0)
    rail = OU(60.0, 0.3, 15.0)
    step = 0.3 * math.sqrt((1.0 - math.exp(-2.0 * 60.0 / rate)) / 120.0)
    phi, turn = math.exp(-60.0 / rate), 2.0 * math.pi * (idle + 0.5 * slope) / rate
    gain = abs(1.0 - phi * np.exp(-1j * turn))
    line = ThrottleTone(step / gain * math.sqrt(4.0 * 60.0 / n), idle, slope, 0.3, 0.0)
    found = discover(Recording(t, SupplyModel((rail, line)).simulate(t, rng, throttle), throttle))
    assert [cause.name for cause in found.causes] == ['throttle_tone']
    term = found.causes[0].term
    assert (term.idle, term.slope) == pytest.approx((idle, slope), abs=1.5)
