"""Rows of `reproduce`: verdicts, numbers against independent calculations, simulations."""

import itertools
import math
import re

import numpy as np
from ou_monitor.paper import oscilloscope, published, tables
from ou_monitor.paper.network import PowerNetwork
from ou_monitor.paper.published import Printed, Row, RowVerdict
import pytest
from scipy.integrate import quad, solve_ivp, trapezoid
from scipy.signal import lfilter, lsim
from scipy.stats import norm


def row(printed, recomputed, **ranges):
    return Row('Table 0', 'x', '', Printed(printed), recomputed, 'how', 'What it says.', **ranges)


@pytest.mark.parametrize('text, value, half_unit', [
    ('63.0', 63.0, 0.05), ('368', 368.0, 0.5), ('315.6e-3', 0.3156, 5e-5),
    ('7.91e-4', 7.91e-4, 5e-7), ('9.38', 9.38, 0.005), ('~0', 0.0, 0.5), ('5e-05', 5e-5, 5e-6)])
def test_rounding_is_half_a_unit_of_the_last_digit(text, value, half_unit):
    """Zeros at the end count; so does the exponent."""
    printed = Printed(text)
    assert printed.value == pytest.approx(value)
    assert printed.half_unit == pytest.approx(half_unit)
    assert printed.ends == pytest.approx((value - half_unit, value + half_unit), rel=1e-6)


@pytest.mark.parametrize('recomputed, verdict', [
    (63.05, RowVerdict.AGREES), (62.95, RowVerdict.AGREES), (63.06, RowVerdict.DOES_NOT_HOLD),
    (62.94, RowVerdict.DOES_NOT_HOLD)])
def test_arithmetic_must_round_to_the_printed_number(recomputed, verdict):
    """Half a unit is rounded rightly either way."""
    assert row('63.0', recomputed).verdict is verdict


@pytest.mark.parametrize('text, recomputed, verdict', [
    ('> 0', 1e-300, RowVerdict.AGREES), ('> 0', 0.0, RowVerdict.DOES_NOT_HOLD),
    ('> 0', -1.0, RowVerdict.DOES_NOT_HOLD), ('< 1', 0.999, RowVerdict.AGREES),
    ('< 1', 1.0, RowVerdict.DOES_NOT_HOLD)])
def test_a_claim_is_a_bound(text, recomputed, verdict):
    assert row(text, recomputed).verdict is verdict


def test_three_standard_errors_reach():
    """2.9 away agrees, 3.1 away does not hold."""
    assert row('10', 10.5 + 2.9, error=1.0).verdict is RowVerdict.AGREES
    assert row('10', 10.5 + 3.1, error=1.0).verdict is RowVerdict.DOES_NOT_HOLD


def test_a_band_replaces_the_error():
    """A narrow band under a wide error decides, and the other way round."""
    assert row('10', 12.0, error=5.0, band=(11.0, 13.0)).verdict is RowVerdict.DOES_NOT_HOLD
    assert row('10', 12.0, error=0.1, band=(10.0, 13.0)).verdict is RowVerdict.AGREES


@pytest.mark.parametrize('name', ['inputs', 'printed_inputs'])
def test_rounding_needs_the_range_of_an_input(name):
    """Apart as they are, together within the range; further apart not even so."""
    near = {'inputs': (10.4, 12.0), 'printed_inputs': (9.0, 11.5)}
    far = {'inputs': (10.6, 12.0), 'printed_inputs': (9.0, 10.9)}
    assert row('10', 11.0).verdict is RowVerdict.DOES_NOT_HOLD
    assert row('10', 11.0, **{name: near[name]}).verdict is RowVerdict.ROUNDING
    assert row('10', 11.0, **{name: far[name]}).verdict is RowVerdict.DOES_NOT_HOLD


@pytest.mark.parametrize('recomputed, ranges', [
    (math.nan, {}), (math.inf, {}), (1.0, {'error': math.nan})])
def test_rows_without_a_number_are_refused(recomputed, ranges):
    with pytest.raises(ValueError, match='x: '):
        row('1', recomputed, **ranges)


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
    return by_quantity(oscilloscope.decay_rows(np.random.default_rng(1), draws=30))


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
    """By the normal equations; 4.303 is the 97.5 % quantile of t with 2 degrees of freedom."""
    line = oscilloscope.PAPER_FIT
    assert (line.alpha, line.alpha_se, line.scatter) == pytest.approx(
        (63.0458, 1.24557, 0.0335379), rel=1e-5)
    assert line.half_width == pytest.approx(4.3027 * line.alpha_se, rel=1e-4)
    assert fig5['alpha'].verdict is RowVerdict.AGREES
    assert fig5['alpha'].recomputed == line.alpha
    assert fig5['|U(0)|'].recomputed == line.start == pytest.approx(373.392, rel=1e-5)


def test_only_one_local_rate_is_off_by_more_than_scatter(fig5):
    """61.0, 61.1, 69.3, 126.5: only the last is off by more than the points scatter."""
    found = [fig5[f'rate, {span} ms'] for span in ('0..10', '10..25', '25..35', '35..50')]
    exact = [math.log(368 / 200) / 0.010, math.log(200 / 80) / 0.015, math.log(2) / 0.010,
             math.log(40 / 6) / 0.015]
    assert [row.recomputed for row in found] == pytest.approx(exact)
    assert exact == pytest.approx([61.0, 61.1, 69.3, 126.5], abs=0.05)
    assert [row.verdict for row in found] == [RowVerdict.AGREES] * 3 + [RowVerdict.DOES_NOT_HOLD]


def test_the_exponential_with_offset_is_the_best():
    """No neighbour has smaller residuals; 56.5 1/s, -14.7 mV, 7.4 times."""
    plain, shifted = oscilloscope.decay_fits()
    for fit in (plain, shifted):
        for k, step in itertools.product(range(len(fit.parameters)), (0.999, 1.001)):
            other = fit.parameters.copy()
            other[k] *= step
            left = oscilloscope.VALUE - oscilloscope.decay(oscilloscope.TIME, *other)
            assert np.sum(left ** 2) > fit.rss
    assert shifted.parameters[1:] == pytest.approx([56.5, -14.7], abs=0.05)
    assert plain.rss / shifted.rss == pytest.approx(7.41, abs=0.01)
    # With (1, 2) degrees of freedom P(F > f) = 1 - sqrt(f / (f + 2)).
    test, p = oscilloscope.offset_test()
    assert test == pytest.approx(2.0 * (plain.rss / shifted.rss - 1.0))
    assert p == pytest.approx(1.0 - math.sqrt(test / (test + 2.0)))


@pytest.mark.parametrize('rail', [30.0, 500.0, 5000.0])
def test_a_step_through_the_coupling_agrees_with_simulation(rail):
    """The closed form against the state-space simulation of both first-order systems."""
    w = 2.0 * math.pi * 10.0
    t = np.linspace(0.0, 0.05, 5001)
    # s/(s + w) of a step that rises as rail/(s + rail).
    _, y, _ = lsim(([rail, 0.0], [1.0, rail + w, rail * w]), np.ones(t.size), t)
    assert oscilloscope.through_coupling(t, rail) == pytest.approx(y, abs=1e-6)


def test_coupling_hides_the_rail():
    """Without noise: never above the corner, and near it for every fast rail."""
    w = 2.0 * math.pi * 10.0
    rates = [oscilloscope.fitted_rate(rail) for rail in (20.0, 100.0, 300.0, 1e3, 1e4, 1e6)]
    assert rates == sorted(rates) and rates[-1] < w
    assert rates[-1] == pytest.approx(w, rel=1e-3) and rates[0] < 25.0
    line = oscilloscope.PAPER_FIT
    assert oscilloscope.fitted_rate(oscilloscope.slowest_rail()) == pytest.approx(
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
def test_the_probability_is_the_printed_integral(delta, var):
    """The density of section 4.4, integrated up to 40 standard deviations above delta."""
    total, _ = quad(norm(0.0, math.sqrt(var)).pdf, delta, delta + 40.0 * math.sqrt(var),
                    epsabs=0.0, epsrel=1e-12)
    assert tables.beyond(delta, var) == pytest.approx(2.0 * total, rel=1e-9)


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
    rows = by_quantity(tables.averaging_rows(np.random.default_rng(7), paths=200))
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


PATHS = 4000


@pytest.fixture(scope='module')
def formulas():
    """Give the rows of section 3.3."""
    return {row.quantity: row for row in tables.switching_rows(np.random.default_rng(11), PATHS)}


@pytest.fixture(scope='module')
def crests():
    """Return simulated crest factors; 600 segments."""
    return oscilloscope.simulate_crests(np.random.default_rng(12), 600)


def long_run_rate(q, c):
    """Return the long-run variance rate by integrating the autocovariance."""
    # 2 integral_0^inf sum pi c exp(Qt) c dt with the equation p' = p Q solved numerically; no
    # potential, no formula (6).
    values, vectors = np.linalg.eig(q.T)
    pi = np.real(vectors[:, np.argmin(np.abs(values))])
    pi /= pi.sum()
    c = c - pi @ c

    def change(t, state):
        return np.concatenate([state[:-1] @ q, [state[:-1] @ c]])

    start = np.concatenate([pi * c, [0.0]])
    end = 60.0 / np.abs(np.diag(q)).min()
    return 2.0 * solve_ivp(change, (0.0, end), start, rtol=1e-10, atol=1e-16).y[-1, -1]


@pytest.mark.parametrize('name, system', [
    ('telegraph', tables.telegraph()), ('three states', tables.three_states())])
def test_intensity_is_twice_the_printed_one(formulas, name, system):
    """Within 4 standard errors of an evaluation without potentials; the printed one refused."""
    # 4000 paths give an error of 2.5 %: the missing factor is 20 standard errors away.
    row = formulas[f'B of (6), {name}']
    exact = 1e6 * long_run_rate(np.array(system.generator.q), system.offsets[:, 0])
    assert row.printed.value == pytest.approx(0.5 * exact, rel=1e-3)
    assert abs(row.recomputed - exact) < 4.0 * row.error
    assert row.error < 0.04 * exact
    assert row.verdict is RowVerdict.DOES_NOT_HOLD


def test_drift_lacks_no_factor(formulas):
    """
    Growth of the mean against the eigenvalue of its own equation; half or twice it is refused.

    E U obeys a linear equation with the rate sqrt(q^2 + c^2) - q.
    """
    row = formulas['b/U of (5), multiplicative noise']
    exact = math.sqrt(1000.0 ** 2 + 100.0 ** 2) - 1000.0
    assert row.printed.value == pytest.approx(100.0 ** 2 / 2000.0)
    assert abs(row.recomputed - exact) < 4.0 * row.error
    assert row.verdict is RowVerdict.AGREES
    assert 0.5 * exact > 8.0 * row.error, 'a factor of 2 would be seen'


def test_logarithm_does_not_grow(formulas):
    """Zero within 4 standard errors, where the printed formulas say 2.5 1/s."""
    row = formulas['growth of ln U by (4) to (6)']
    assert row.printed.value == pytest.approx(2.5)
    assert abs(row.recomputed) < 4.0 * row.error < 1.0
    assert row.verdict is RowVerdict.DOES_NOT_HOLD


def test_the_potential_of_a_telegraph_agrees(formulas):
    row = formulas['R0(0, 0) of a telegraph']
    assert row.recomputed == pytest.approx(0.25) and row.verdict is RowVerdict.AGREES


def test_crest_factors_are_those_of_1_mhz(crests):
    """Against paths drawn sample by sample at 1 MHz, without bridges: mean and 95 % quantile."""
    # 10000 screens of 10 ms: the mean to 0.007. What 1 MHz leaves unseen is 0.04 there, ten times
    # as much is what lies between the points of the simulation.
    rng, phi = np.random.default_rng(14), math.exp(-63e-6)
    direct = []
    for _ in range(100):
        noise = math.sqrt(1.0 - phi * phi) * rng.standard_normal((100, 10_000))
        noise[:, 0] = rng.standard_normal(100)
        u = lfilter([1.0], [1.0, -phi], noise, axis=1)
        direct.append(np.ptp(u, axis=1) / u.std(axis=1))
    direct = np.concatenate(direct)
    mean, error = crests.mean(10)
    error = math.hypot(error, direct.std() / math.sqrt(direct.size))
    assert abs(mean - direct.mean()) < 4.0 * error < 0.03
    # A quantile scatters by sqrt(p (1 - p) / n) / density; the density there is above 0.15.
    limit = 4.0 * math.sqrt(0.05 * 0.95 / 10_000) / 0.15
    assert abs(crests.quantile(10, 0.95) - np.quantile(direct, 0.95)) < limit


def test_verdicts_on_the_crest_factors(crests):
    """40 % agrees, 5 % only within its rounding; 10 % by what the screens say, either way."""
    low, medium, high = oscilloscope.crest_rows(crests)
    assert (low.verdict, high.verdict) == (RowVerdict.ROUNDING, RowVerdict.AGREES)
    # (225 - 3.1) / (28.1 + 4.7), the least that the readings allow.
    least = (225.0 - 3.125) / (28.1 + 4.69)
    assert medium.printed_inputs[0] == pytest.approx(least, rel=1e-3)
    inside = crests.quantile(500, 0.95) >= medium.printed_inputs[0]
    assert medium.verdict is (RowVerdict.ROUNDING if inside else RowVerdict.DOES_NOT_HOLD)


def test_jumps_raise_the_crest_factor_of_long_screens(crests):
    """Beyond the OU on 500 ms; rows name what was best, and size gives back the variance."""
    found = oscilloscope.simulate_jumps(np.random.default_rng(17), 20.0)
    best = max((c for c in found if c.screen == 500), key=lambda c: c.mean)
    assert best.mean - crests.mean(500)[0] > 5.0 * best.error
    share = best.size(1.0) ** 2 * best.rate / (2.0 * published.ALPHA.value)
    assert share == pytest.approx(best.share)
    rows = oscilloscope.jump_rows(found, crests)
    assert len(rows) == 5 and rows[2].recomputed == best.mean
    assert rows[0].recomputed == pytest.approx((287.5 / 56.3) / (81.3 / 9.38))
    assert f' {81.3 - 9.38 * crests.mean(100)[0]:.0f} mV to the OU' in rows[1].sentence
