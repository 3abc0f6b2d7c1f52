"""Recomputed numbers against an independent calculation."""

import math
import re

import numpy as np
from ou_monitor.paper import published, switching, tables, transient
from ou_monitor.paper.network import PowerNetwork
from ou_monitor.paper.published import Printed, RowVerdict
import pytest
from scipy.integrate import trapezoid
from scipy.signal import lsim
from scipy.stats import norm


def by_quantity(rows):
    """Return rows by their quantity, which must be unique."""
    found = {row.quantity: row for row in rows}
    assert len(found) == len(rows)
    return found


@pytest.fixture(scope='module')
def first_table():
    """Return the rows of Table 1, for white noise of a crest factor of 8.77."""
    return by_quantity(tables.table_1(8.77, 0.02))


@pytest.fixture(scope='module')
def fig5():
    """Return the rows of Fig. 5; few simulations, since others test them."""
    return by_quantity(transient.rows(np.random.default_rng(1), draws=30))


def test_steps_of_the_oscilloscope():
    """6.25 mV and 9.375 mV, and by hand how many of them each reading is."""
    vpp, vrms = published.VPP_STEP, published.VRMS_STEP
    assert vpp.low <= 6.25 * (1 + 1e-9) and 6.25 <= vpp.high < 6.26
    assert vrms.low <= 9.375 * (1 + 1e-9) and 9.375 <= vrms.high < 9.39
    assert vpp.multiples == (10, 13, 36, 46) and vrms.multiples == (1, 3, 6)


def test_chance_of_a_step_is_about_right():
    # The formula is a bound on a union, so the count lies between a fifth and twice of it; 5000
    # triples.
    rng = np.random.default_rng(3)
    claimed = published.VRMS_STEP.chance
    hits = 0
    for second, third in rng.uniform([20.0, 50.0], [38.0, 62.0], (5_000, 2)):
        readings = [Printed('9.38'), Printed(f'{second:.1f}'), Printed(f'{third:.1f}')]
        try:
            hits += published.common_step(readings).size > 9.0
        except ValueError:
            pass
    assert 0.2 * claimed * 5_000 < hits < 2.0 * claimed * 5_000


def test_amp_can_be_a_peak_at_5_percent_only(first_table):
    verdicts = {q: r.verdict for q, r in first_table.items() if q.startswith('Amp')}
    assert verdicts.pop('Amp, 5 %') is RowVerdict.AGREES
    assert len(verdicts) == 3 and set(verdicts.values()) == {RowVerdict.DOES_NOT_HOLD}
    assert first_table['Amp, 10 %'].recomputed == 112.5


def test_idle_reads_zero_below_one_step(first_table):
    """62.5/8.77 = 7.13 mV: above half a step, below one."""
    found = first_table['Vrms, motors off']
    assert found.recomputed == pytest.approx(7.127, abs=1e-3)
    assert found.verdict is RowVerdict.ROUNDING


def test_exponents_of_growth_agree_with_brute_force():
    """From the steps ln 3 / ln 2 = 1.585 and ln 2 / ln 4 = 0.5; ranges by brute force."""
    for pair, exact in (((published.LOW, published.MEDIUM), math.log(3) / math.log(2)),
                        ((published.MEDIUM, published.HIGH), 0.5)):
        value, (low, high) = tables.exponent(*pair)
        assert value == pytest.approx(exact, abs=0.003)
        span = math.log(pair[1].load / pair[0].load)
        corners = [math.log((pair[1].vrms.value + a) / (pair[0].vrms.value + b)) / span
                   for a in (-4.6895, 4.6895) for b in (-4.6895, 4.6895)]
        assert (low, high) == pytest.approx((min(corners), max(corners)), abs=1e-3)


def test_alpha_by_least_squares(fig5):
    t, y = np.array([0.0, 0.010, 0.025, 0.035]), np.log([368.0, 200.0, 80.0, 40.0])
    design = np.column_stack([np.ones(4), t])
    normal = np.linalg.inv(design.T @ design)
    beta = normal @ design.T @ y
    residual = y - design @ beta
    se = math.sqrt(residual @ residual / 2.0 * normal[1, 1])
    line = transient.PAPER_FIT
    assert line.alpha == pytest.approx(-beta[1]) == pytest.approx(63.046, abs=5e-4)
    assert line.alpha_se == pytest.approx(se)
    assert line.scatter == pytest.approx(math.sqrt(residual @ residual / 2.0))
    # The 97.5 % quantile of Student's t with 2 degrees of freedom, from tables.
    assert line.half_width == pytest.approx(4.303 * se, rel=1e-3)
    assert fig5['alpha'].verdict is RowVerdict.AGREES
    assert fig5['alpha'].recomputed == line.alpha
    assert fig5['|U(0)|'].recomputed == pytest.approx(math.exp(beta[0]))


def test_only_one_local_rate_is_off_by_more_than_scatter(fig5):
    """61.0, 61.1, 69.3, 126.5: only the last is off by more than the points scatter."""
    found = [fig5[f'rate, {span} ms'] for span in ('0..10', '10..25', '25..35', '35..50')]
    exact = [math.log(368 / 200) / 0.010, math.log(200 / 80) / 0.015, math.log(2) / 0.010,
             math.log(40 / 6) / 0.015]
    assert [row.recomputed for row in found] == pytest.approx(exact)
    assert exact == pytest.approx([61.0, 61.1, 69.3, 126.5], abs=0.05)
    assert [row.verdict for row in found] == [RowVerdict.AGREES] * 3 + [RowVerdict.DOES_NOT_HOLD]


def test_the_exponential_with_offset_agrees_with_profiling():
    """By profiling: for each rate start and offset are linear; 56.5 1/s, -14.7 mV, 7.4 times."""
    t, u = transient.TIME, transient.VALUE

    def profile(alpha, offset):
        columns = [np.exp(-alpha * t)] + ([np.ones(5)] if offset else [])
        design = np.column_stack(columns)
        beta, *_ = np.linalg.lstsq(design, u, rcond=None)
        return float(np.sum((u - design @ beta) ** 2)), beta

    grid = np.arange(40.0, 80.0, 0.01)
    best = {offset: min(grid, key=lambda a: profile(a, offset)[0]) for offset in (False, True)}
    plain, shifted = transient.decay_fits()
    assert shifted.parameters[1] == pytest.approx(best[True], abs=0.02)
    assert plain.parameters[1] == pytest.approx(best[False], abs=0.02)
    assert shifted.parameters[2] == pytest.approx(profile(best[True], True)[1][1], abs=0.02)
    assert shifted.parameters[1:] == pytest.approx([56.5, -14.7], abs=0.05)
    assert plain.rss / shifted.rss == pytest.approx(
        profile(best[False], False)[0] / profile(best[True], True)[0], rel=1e-3)
    # With (1, 2) degrees of freedom P(F > f) = 1 - sqrt(f / (f + 2)).
    test, p = transient.offset_test()
    assert test == pytest.approx(2.0 * (plain.rss / shifted.rss - 1.0))
    assert p == pytest.approx(1.0 - math.sqrt(test / (test + 2.0)))


@pytest.mark.parametrize('rail', [30.0, 500.0, 5000.0])
def test_a_step_through_the_coupling_agrees_with_simulation(rail):
    """The closed form against the state-space simulation of both first-order systems."""
    w = 2.0 * math.pi * 10.0
    t = np.linspace(0.0, 0.05, 5001)
    # s/(s + w) of a step that rises as rail/(s + rail).
    _, y, _ = lsim(([rail, 0.0], [1.0, rail + w, rail * w]), np.ones(t.size), t)
    assert transient.through_coupling(t, rail) == pytest.approx(y, abs=1e-6)


def test_coupling_hides_the_rail():
    """Without noise: never above the corner, and near it for every fast rail."""
    w = 2.0 * math.pi * 10.0
    rates = [transient.fitted_rate(rail) for rail in (20.0, 100.0, 300.0, 1e3, 1e4, 1e6)]
    assert rates == sorted(rates) and rates[-1] < w
    assert rates[-1] == pytest.approx(w, rel=1e-3) and rates[0] < 25.0
    line = transient.PAPER_FIT
    assert transient.fitted_rate(transient.slowest_rail()) == pytest.approx(
        line.alpha - line.half_width)


def test_table_2_is_recomputed_by_hand():
    rows = by_quantity([r for r in tables.table_2() if r.where in ('Table 2', 'Section 5')])
    assert rows['sqrt(2 alpha)'].recomputed == pytest.approx(11.2249722)
    assert rows['tau'].recomputed == pytest.approx(15.8730159)
    assert rows['sigma, 10 %'].recomputed == pytest.approx(0.3154217, abs=1e-6)
    assert rows['sigma, 40 %'].recomputed == pytest.approx(0.6319659, abs=1e-6)
    assert rows['sigma, 10 %'].verdict is RowVerdict.ROUNDING
    assert rows['sigma, 40 %'].verdict is RowVerdict.AGREES
    assert rows['Var_inf, 10 %'].recomputed == pytest.approx(0.3156 ** 2 / 126.0)
    assert rows['Var_inf, 40 %'].recomputed == pytest.approx(0.632 ** 2 / 126.0)
    # Half a step of 9.379 mV, and 5.359/63.046 of alpha, of which sigma feels half.
    for label, sigma, vrms in (('10 %', 0.3154217, 28.1), ('40 %', 0.6319659, 56.3)):
        width = sigma * math.hypot(4.6896 / vrms, 0.5 * 5.359 / 63.046)
        found = rows[f'implied error, {label}']
        assert found.recomputed == pytest.approx(width, rel=1e-3)
        assert found.verdict is RowVerdict.DOES_NOT_HOLD


@pytest.mark.parametrize('delta', [0.01, 0.1, 0.3])
@pytest.mark.parametrize('var', [7.91e-4, 3.17e-3])
def test_the_probability_agrees_in_three_ways(delta, var):
    """Closed form, printed integral, and the normal law."""
    exact = 2.0 * norm.sf(delta / math.sqrt(var))
    assert tables.beyond(delta, var) == pytest.approx(exact, rel=1e-12)
    assert tables.beyond_by_quadrature(delta, var) == pytest.approx(exact, rel=1e-9)


def test_probability_by_simulation():
    """The count is within 4 standard errors, which a variance 3 % off would not be."""
    # 200000 samples at 50 mV and 40 %: an error of 0.3 % of P; d ln P / d ln var is 0.64 there.
    rows = by_quantity(tables.probabilities(np.random.default_rng(5), draws=200_000))
    row = rows['P(|U| > 50 mV), 40 %']
    exact, off = (2.0 * norm.sf(0.05 / (0.0563 * math.sqrt(f))) for f in (1.0, 1.03))
    assert row.printed.value == pytest.approx(exact, rel=1e-3)
    assert abs(row.recomputed - exact) < 4.0 * row.error < off - exact
    ratio = rows['P(|U| > 100 mV), 40 % over 10 %'].recomputed
    assert ratio == pytest.approx(norm.sf(100 / 56.3) / norm.sf(100 / 28.1))


def test_falls_agree_with_simulated_paths():
    """Mean time from the mean to 100 mV below, against simulated paths at 40 %."""
    # 2000 paths in steps of 0.2 ms, up to the last passage; a discrete path passes as if the level
    # were 0.58 sigma sqrt(dt) = 5.2 mV further away.
    rng, dt, s = np.random.default_rng(6), 2e-4, 0.0563
    phi = math.exp(-63.0 * dt)
    level = 0.1 - 0.5826 * s * math.sqrt(2.0 * 63.0 * dt)
    u, time, alive = np.zeros(2000), np.zeros(2000), np.ones(2000, dtype=bool)
    while alive.any():
        u[alive] = phi * u[alive] + s * math.sqrt(1.0 - phi * phi) * rng.standard_normal(
            int(alive.sum()))
        time[alive] += dt
        alive &= u < level
    row = by_quantity(tables.probabilities(rng, 1000))['rate of falls by 100 mV, 40 over 10 %']
    said = float(re.search(r'([0-9.]+) s at 40 %', row.sentence).group(1))
    assert abs(time.mean() - said) < 4.0 * time.std() / math.sqrt(2000) + 0.02 * said
    assert row.verdict is RowVerdict.AGREES


def test_more_capacitance_lowers_alpha_and_variance():
    """1/(R C) and S R/(2 C); both elasticities are -1, so alpha falls."""
    alpha, var = tables.rc_rail(0.05, 2e-3, 3e-6)
    assert alpha == pytest.approx(1e4) and var == pytest.approx(3e-6 * 0.05 / (2.0 * 2e-3))
    rows = by_quantity(tables.hardware_and_growth())
    assert rows['d ln alpha / d ln C'].recomputed == pytest.approx(-1.0)
    assert rows['d ln alpha / d ln C'].verdict is RowVerdict.DOES_NOT_HOLD
    assert rows['d ln Var_inf / d ln C'].recomputed == pytest.approx(-1.0)
    assert rows['d ln Var_inf / d ln C'].verdict is RowVerdict.AGREES
    before, after = tables.doubled(PowerNetwork())
    assert after.alpha < before.alpha and after.var_inf < before.var_inf


def test_share_of_the_variance_at_the_esc_lines():
    """The Lorentzian integrated from 24 kHz up, over its whole."""
    f = np.geomspace(24e3, 1e12, 20001)
    density = 4.0 * 63.0 / (63.0 ** 2 + (2.0 * math.pi * f) ** 2)
    above = float(trapezoid(density * f, np.log(f)))
    assert tables.share_above(24e3) == pytest.approx(above, rel=1e-4)


def test_the_printed_matrix_grows_and_the_averaged_one_relaxes():
    rows = by_quantity(switching.averaging_rows(np.random.default_rng(7), paths=200))
    assert rows['P(tau)/P(0), +gamma on the diagonal'].recomputed == pytest.approx(math.e)
    assert rows['phase: late over early advance'].recomputed == pytest.approx(math.e)
    amplitude = rows['amplitude: late over early decay']
    assert abs(amplitude.recomputed - 1.0) < 4.0 * amplitude.error < 0.01
    # P = exp(-a t) + beta (exp(-a t) - exp(-A t)) / (A - a), a = 63, A = 100, beta = 40.
    t = np.array([0.0, 0.5, 1.0]) / 63.0
    power = np.log(np.exp(-63 * t) + 40 * (np.exp(-63 * t) - np.exp(-100 * t)) / 37)
    exact = (power[2] - power[1]) / (power[1] - power[0])
    found = rows['power: late over early decay']
    assert abs(found.recomputed - exact) < 4.0 * found.error + 0.005
    assert found.verdict is RowVerdict.DOES_NOT_HOLD
