"""First passage with other terms against limits and two simulators."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model.passage.extended import ExtendedPassage
from ou_monitor.model.passage.law import passage_probability
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
import pytest
from scipy.special import ndtr

ALPHA, SIGMA, U0 = 2.0, 0.2, 12.0
SD = SIGMA / math.sqrt(2.0 * ALPHA)
LIVE = {'alpha': ALPHA, 'sigma': SIGMA, 'u0': U0}


def term(name, **values):
    """Return a term of the catalogue."""
    return catalogue()[name](**values)


def passage(*terms, alpha=ALPHA, sigma=SIGMA):
    """Return the passage of a model with these terms, ready."""
    made = ExtendedPassage(SupplyModel((term('ou', alpha=ALPHA, sigma=SIGMA, u0=U0), *terms)))
    made.prepare(alpha, sigma)
    return made


JUMPS = term('jumps', rate=0.4, mean=-0.05, std=0.25)
SWITCH = term('regime_switching', rate_up=0.3, rate_down=1.0, level=0.0, sigma_ratio=2.0,
              at_once=0.0, states=2.0)
STEPS = term('regime_switching', rate_up=0.5, rate_down=1.5, level=-0.15, sigma_ratio=1.0,
             at_once=0.5, states=2.0)
THREE = term('regime_switching', rate_up=0.4, rate_down=0.8, level=-0.05, sigma_ratio=1.5,
             at_once=0.0, states=3.0)
VOLATILITY = term('volatility', std=0.4, rate=0.5)


@pytest.fixture(scope='module')
def jumping():
    """With jumps."""
    return passage(JUMPS)


@pytest.mark.parametrize('terms', [
    (), (term('measurement_noise', std=0.1),), (term('glitches', probability=0.1, std=1.0),),
    (term('jumps', rate=0.0, mean=0.0, std=1.0),), (term('volatility', std=0.0, rate=1.0),)])
def test_nothing_added_is_the_plain_law(terms):
    """Also with what only the sensor does, and with terms of no effect."""
    start, level = np.array([12.0, 11.9, 11.8]), np.array([11.7, 11.6, 11.5])
    p = passage(*terms).probability(start, level, 3.0, **LIVE)
    expected = passage_probability((U0 - start) / SD, (U0 - level) / SD, 3.0 * ALPHA)
    np.testing.assert_allclose(p, expected, rtol=1e-12)


def test_next_to_nothing_added():
    """Regimes that are alike, jumps of no size: the plain law, through the tables."""
    alike = term('regime_switching', rate_up=1.0, rate_down=3.0, level=0.0, sigma_ratio=1.0,
                 at_once=0.0, states=2.0)
    still = term('jumps', rate=1.0, mean=0.0, std=0.0)
    level = U0 - SD * np.array([1.0, 2.0, 3.0, 4.0])
    for made in (passage(alike), passage(still)):
        for start in (U0, U0 - 0.8 * SD, U0 + SD):
            for horizon in (0.05, 1.0, 10.0, 100.0):
                p = made.probability(start, level, horizon, **LIVE)
                expected = passage_probability((U0 - start) / SD, (U0 - level) / SD,
                                               horizon * ALPHA)
                seen = expected > 1e-6
                np.testing.assert_allclose(p[seen], expected[seen], rtol=0.06)
                np.testing.assert_allclose(p, expected, atol=0.01)


def test_names():
    """What is used, and what moves the supply and is not."""
    made = passage(JUMPS, term('drift', rate=0.01, curvature=0.0), term('quantization', step=0.01),
                   term('measurement_noise', std=0.1), SWITCH, term('heavy_tails', dof=5.0))
    assert made.used == ('jumps', 'regime_switching')
    assert made.left_out == ('drift', 'heavy_tails')


@pytest.mark.parametrize('std, gap', [(0.1, 0.25), (0.3, 0.4), (0.5, 0.3)])
def test_jumps_alone(std, gap):
    """1 - exp(-rate P(size > gap) h) where the OU hardly moves and jumps are few."""
    alpha, sigma = 1e-3, 1e-3 * math.sqrt(2e-3) * 5.0
    made = passage(term('jumps', rate=1e-3, mean=0.0, std=std), alpha=alpha, sigma=sigma)
    for horizon in (0.5, 5.0, 20.0):
        p = made.probability(12.0, 12.0 - gap, horizon, alpha=alpha, sigma=sigma, u0=12.0)
        expected = -math.expm1(-1e-3 * horizon * ndtr(-gap / std))
        # Two jumps, and what relaxes between.
        assert p == pytest.approx(expected, rel=0.02 + 0.025 * horizon * (gap > 2.0 * std) / 10.0
                                  + 1e-3 * horizon)


def test_a_step_of_the_level_alone():
    """A step down at the rate of going up a state, and no more, where the OU hardly moves."""
    alpha, sigma = 1e-3, 1e-3 * math.sqrt(2e-3)
    made = passage(term('regime_switching', rate_up=0.02, rate_down=0.06, level=-0.05,
                        sigma_ratio=1.0, at_once=1.0, states=2.0), alpha=alpha, sigma=sigma)
    for horizon in (1.0, 5.0, 20.0):
        p = made.probability(12.0, 11.97, horizon, alpha=alpha, sigma=sigma, u0=12.0)
        # In the lower state, at the same voltage, changes up and down bring nothing.
        expected = 0.75 * -math.expm1(-0.02 * horizon)
        assert p == pytest.approx(expected, rel=0.02)


def simulated(start, level, horizon, *, jumps=(0.0, 0.0, 0.0), rates=None, means=(0.0,),
              at_once=0.0, ratios=(1.0,), wander=(0.0, 1.0), paths=16_000):
    """Return chance and standard error by small steps with the bridge between them."""
    rng = np.random.default_rng(3)
    n = math.ceil(horizon * ALPHA / 4e-3)
    h = horizon / n
    means, ratios = np.array(means), np.array(ratios)
    move = np.eye(means.size)
    law = np.ones(1)
    if rates is not None:
        rates = np.array(rates)
        move = move + h * (rates - np.diag(rates.sum(axis=1)))
        law = np.linalg.matrix_power(move, 100_000)[0]
    state = rng.choice(means.size, paths, p=law)
    log = wander[0] * rng.standard_normal(paths)
    v, alive = np.full(paths, float(start)), np.ones(paths)
    for _ in range(n):
        s = SIGMA * ratios[state] * np.exp(log)
        mean = U0 + means[state]
        new = v - ALPHA * h * (v - mean) + s * math.sqrt(h) * rng.standard_normal(paths)
        gaps = np.maximum(v - level, 0.0) * np.maximum(new - level, 0.0)
        alive *= -np.expm1(-2.0 * gaps / (s * s * h))
        count = rng.poisson(jumps[0] * h, paths)
        new += count * jumps[1] + np.sqrt(count) * jumps[2] * rng.standard_normal(paths)
        after = (rng.random(paths)[:, None] > np.cumsum(move, axis=1)[state][:, :-1]).sum(axis=1)
        v = new + at_once * (means[after] - means[state])
        state = after
        log += -wander[1] * h * log + wander[0] * math.sqrt(2.0 * wander[1] * h
                                                            ) * rng.standard_normal(paths)
        alive[v <= level] = 0.0
    return 1.0 - alive.mean(), alive.std() / math.sqrt(paths)


@pytest.mark.parametrize('terms, kinds', [
    ((JUMPS,), {'jumps': (0.4, -0.05, 0.25)}),
    ((SWITCH,), {'rates': [[0, 0.3], [1, 0]], 'means': (0, 0), 'ratios': (1, 2)}),
    ((STEPS,), {'rates': [[0, 0.5], [1.5, 0]], 'means': (0, -0.15), 'ratios': (1, 1),
                'at_once': 0.5}),
    ((THREE,), {'rates': [[0, 0.4, 0.4], [0.8, 0, 0.4], [0.8, 0.8, 0]],
                'means': (0, -0.05, -0.1), 'ratios': (1, 1.5, 2.25)}),
    ((VOLATILITY,), {'wander': (0.4, 0.5)}),
    ((JUMPS, STEPS), {'jumps': (0.4, -0.05, 0.25), 'rates': [[0, 0.5], [1.5, 0]],
                      'means': (0, -0.15), 'ratios': (1, 1), 'at_once': 0.5})],
    ids=['jumps', 'switch', 'steps', 'three', 'volatility', 'both'])
def test_small_steps(terms, kinds):
    """An Euler simulator of its own: four standard errors and 2 % for its steps."""
    made = passage(*terms)
    for start, level, horizon in ((12.0, 11.75, 1.0), (11.95, 11.85, 0.3), (12.1, 11.7, 2.0)):
        expected, error = simulated(start, level, horizon, **kinds)
        p = made.probability(start, level, horizon, **LIVE)
        assert abs(p - expected) < 4.0 * error + 0.02 * expected
        plain = passage_probability((U0 - start) / SD, (U0 - level) / SD, horizon * ALPHA)
        if horizon > 0.5:
            # It is no test unless the terms matter.
            assert expected - plain > 8.0 * error


@pytest.mark.parametrize('made_of, level', [
    (term('jumps', rate=0.2, mean=0.0, std=0.3), 11.65),
    # Regimes that change much faster than the supply: its start tells nothing of them.
    (term('regime_switching', rate_up=10.0, rate_down=20.0, level=0.0, sigma_ratio=2.0,
          at_once=0.0, states=2.0), 11.72)], ids=['jumps', 'switch'])
def test_simulator_of_the_model(made_of, level):
    """
    The mean prediction over stretches of 1 s is the share of them with a passage.

    Samples see the level moved by 0.5826 sqrt(2 alpha dt) standard deviations.
    """
    rate, stretches = 400, 3000
    model = SupplyModel((term('ou', alpha=ALPHA, sigma=SIGMA, u0=U0), made_of))
    v = model.simulate(np.arange(rate * stretches) / rate, np.random.default_rng(8))
    v = v.reshape(stretches, rate)
    made = ExtendedPassage(model)
    made.prepare(ALPHA, SIGMA)
    moved = level - 0.5826 * math.sqrt(2.0 * ALPHA / rate) * SD
    p = made.probability(v[:, 0], moved, 1.0, **LIVE)
    seen = (v < level).any(axis=1)
    plain = passage_probability((U0 - v[:, 0]) / SD, (U0 - moved) / SD, ALPHA)
    # Stretches follow each other; twice the error of independent ones.
    error = 2.0 * math.sqrt(p.mean() * (1.0 - p.mean()) / stretches)
    assert abs(seen.mean() - p.mean()) < 3.0 * error
    assert p.mean() - plain.mean() > 3.0 * error


def test_jumps_change_the_odds_by_orders_of_magnitude():
    """One jump in 100 s, of three standard deviations: at 6 it is all of the risk."""
    made = passage(term('jumps', rate=0.01, mean=0.0, std=3.0 * SD))
    ratio = [float(made.probability(U0, U0 - b * SD, 5.0, **LIVE)
                   / passage_probability(0.0, b, 5.0 * ALPHA)) for b in (4.0, 5.0, 6.0)]
    assert 1.5 < ratio[0] < 4.0 and 30.0 < ratio[1] < 100.0 and ratio[2] > 3000.0
    # Over 5 s each of 0.05 jumps goes beyond with at least this chance.
    p = made.probability(U0, U0 - 8.0 * SD, 5.0, **LIVE)
    assert 0.05 * ndtr(-8.0 / 3.0) * 0.97 < p < 0.05 * ndtr(-6.0 / 3.0)


@settings(max_examples=100, deadline=None)
@given(st.floats(11.0, 12.5), st.floats(10.5, 12.2), st.floats(0.0, 0.5), st.floats(0.0, 300.0),
       st.floats(1.0, 4.0))
def test_monotone(jumping, start, level, less, horizon, longer):
    """No less likely for a higher level, a longer horizon and a lower start, within 3 %."""
    p = jumping.probability([start, start, start, start - less],
                            [level, level - less, level, level],
                            [horizon, horizon, horizon * longer, horizon], **LIVE)
    assert ((p >= 0.0) & (p <= 1.0)).all()
    assert p[1] <= p[0] * 1.03 + 1e-12
    assert p[2] >= p[0] * 0.97 and p[3] >= p[0] * 0.97


def test_between_and_beside_the_tables(jumping):
    """The same from tables made around other parameters near by."""
    at = {'alpha': ALPHA * 1.12, 'sigma': SIGMA * 0.93, 'u0': U0}
    other = passage(JUMPS, alpha=at['alpha'], sigma=at['sigma'])
    level = np.array([11.9, 11.7, 11.4, 11.0])
    for horizon in (0.1, 5.0, 40.0):
        np.testing.assert_allclose(jumping.probability(U0, level, horizon, **at),
                                   other.probability(U0, level, horizon, **at), rtol=0.03)


def test_fast_regimes_are_one_noise():
    """Of two intensities that change 60 times in a relaxation time the mean square counts."""
    made = passage(term('regime_switching', rate_up=60.0, rate_down=60.0, level=0.0,
                        sigma_ratio=2.0, at_once=0.0, states=2.0))
    for b, horizon in ((1.5, 0.3), (2.5, 2.0), (3.0, 20.0)):
        p = made.probability(U0, U0 - b * math.sqrt(2.5) * SD, horizon, **LIVE)
        assert p == pytest.approx(float(passage_probability(0.0, b, horizon * ALPHA)), rel=0.1)


def test_the_same_tables_near_by(jumping):
    """What is near is answered from the tables there are, to the last bit."""
    before = jumping.probability(U0, 11.5, 1.0, **LIVE)
    jumping.prepare(ALPHA * 1.03, SIGMA * 1.03)
    assert jumping.probability(U0, 11.5, 1.0, **LIVE) == before
    jumping.prepare(ALPHA * 2.0, SIGMA * 2.0)
    assert math.isnan(jumping.probability(U0, 11.5, 1.0, **LIVE))
    jumping.prepare(ALPHA, SIGMA)
    assert jumping.probability(U0, 11.5, 1.0, **LIVE) == before


def test_beyond_the_longest_span(jumping):
    """Passages then come at a steady rate: survival falls by the same factor."""
    left = np.log1p(-jumping.probability(U0, 11.2, [30.0, 45.0, 60.0, 75.0], **LIVE))
    np.testing.assert_allclose(np.diff(left) / np.diff(left)[0], 1.0, rtol=0.02)
    assert jumping.probability(U0, 11.2, 1e7, **LIVE) == pytest.approx(1.0)


def test_not_ready(jumping):
    """Unknown before `prepare` and for quite other parameters; what is below is certain."""
    raw = ExtendedPassage(SupplyModel((term('ou', alpha=ALPHA, sigma=SIGMA, u0=U0), JUMPS)))
    p = raw.probability([12.0, 11.0], 11.5, 1.0, **LIVE)
    assert math.isnan(p[0]) and p[1] == 1.0
    assert math.isnan(jumping.probability(12.0, 11.5, 1.0, alpha=20.0, sigma=SIGMA, u0=U0))
    p = jumping.probability([12.0, math.nan, 12.0, 12.0], [11.5, 11.5, math.nan, 11.5],
                            [0.0, 1.0, 1.0, math.nan], **LIVE)
    np.testing.assert_array_equal(p, [0.0, math.nan, math.nan, math.nan])


def test_bad_input(jumping):
    """Refused with the reason."""
    for alpha, sigma, word in ((0.0, 0.1, 'alpha'), (math.nan, 0.1, 'alpha'), (1.0, 0.0, 'sigma'),
                               (1.0, math.inf, 'sigma')):
        with pytest.raises(ValueError, match=f'{word} must be positive'):
            jumping.prepare(alpha, sigma)
    with pytest.raises(ValueError, match='must be positive'):
        jumping.probability(12.0, 11.0, 1.0, alpha=-1.0, sigma=0.2, u0=12.0)
    with pytest.raises(ValueError, match='horizon must be zero or positive'):
        jumping.probability(12.0, 11.0, -1.0, **LIVE)
