"""False-alarm rates and power of the fleet report, on tables with known truth."""

from datetime import datetime, timedelta, timezone
import math

import numpy as np
from ou_monitor.fleet.judgement import (
    DRIFT_RATE, judge, LEAST_FLIGHTS, OF_PACK, OUTLIER_RATE, outliers, QUANTITIES, trends,
    values_of, weighted_line)
import pytest
from scipy import stats
from simulated_fleets import BEND, LEVELS, PACK, SLOPE, table


def test_the_curve_over_throttle_is_taken_out():
    """Recordings at unlike throttles become comparable; neither vehicles nor outliers bend it."""
    rng = np.random.default_rng(1)
    rows = table(rng, 6, 12, scatter=0.02, odd_vehicles={0: 2.0},
                 odd_flights={(1, 3): 3.0, (2, 5): -3.0})
    # Vehicle 0, with four times the noise, flies only at high throttle.
    rows = [row for row in rows if row['vehicle'] != 'uav0' or row['throttle'] > 0.2]
    values = values_of(rows, 'sigma')
    u = np.array([0.1, 0.5])
    truth = SLOPE * u + BEND * u * u
    found = values.curve(u)
    # The error of a difference of levels: 0.2 / sqrt(time) in each of some 60 recordings.
    error = 0.2 * math.sqrt(1.0 / 20.0 + 1.0 / 10.0) / math.sqrt(60.0)
    assert found[1] - found[0] == pytest.approx(truth[1] - truth[0], abs=4.0 * error)
    assert len(values.paths) == 72


def test_a_bend_between_near_throttles_is_followed():
    """Knots may be 0.03 of throttle apart: a rise within 0.1 is not spread over 0.2."""
    rows = table(np.random.default_rng(3), 4, 12, scatter=0.02,
                 levels=[(u, 30.0) for u in np.arange(0.1, 0.5, 0.05)])
    for row in rows:
        row['sigma'] = math.exp(np.interp(row['throttle'], (0.24, 0.31), (0.0, 2.0)))
    curve = values_of(rows, 'sigma').curve
    rise = np.diff(curve(np.array([0.2, 0.35])))[0]
    assert rise == pytest.approx(2.0, abs=0.1)


def test_the_curve_knows_its_error():
    rng = np.random.default_rng(11)
    slopes, errors, runs = [], [], 300
    for _ in range(runs):
        rows = []
        for k, u in enumerate(rng.uniform(0.1, 0.6, 10)):
            flight = 0.3 * rng.standard_normal()
            rows += [{'path': f'f{k}', 'vehicle': 'v', 'flight': k + 1, 'status': 'OK',
                      'start': None, 'throttle': u + du, 'time_s': 10.0, 'alpha': None,
                      'sigma_se': 0.02,
                      'sigma': math.exp(2.0 * u + flight + 0.02 * rng.standard_normal())}
                     for du in (0.0, 0.02)]
        curve = values_of(rows, 'sigma').curve
        slopes.append((curve.heights[1] - curve.heights[0]) / (curve.knots[1] - curve.knots[0]))
        errors.append(math.sqrt(curve.covariance[0, 0]))
    # The median of an error with 8 degrees of freedom is 0.96 of it, the scatter of 300 is known
    # to 4 %; levels taken for independent would make it too small by the root of two.
    assert 0.96 - 0.16 < np.median(errors) / np.std(slopes) < 0.96 + 0.16
    assert np.mean(slopes) == pytest.approx(2.0, abs=4.0 * np.std(slopes) / math.sqrt(runs) + 0.05)


def test_without_throttle_recordings_are_compared_unchanged():
    rng = np.random.default_rng(2)
    rows = table(rng, 1, 6, levels=((None, 20.0),))
    rows[0] |= {'status': 'TOO_SHORT', 'sigma': None, 'alpha': None, 'sag_full': None}
    values = values_of(rows, 'sigma')
    assert len(values.paths) == 5 and values.curve(np.array([0.7])) == 0.0
    np.testing.assert_allclose(np.exp(values.value), [row['sigma'] for row in rows[1:]])
    assert not judge([]).trends and not judge([]).odd_recordings()


@pytest.mark.parametrize('sizes', [(4, 4, 4), (30, 5, 12, 4, 9)])
def test_outliers_keep_their_rate(sizes):
    """A normal fleet of any make shows a false alarm as often as is stated."""
    rng = np.random.default_rng(3)
    groups = [f'v{k}' for k, n in enumerate(sizes) for _ in range(n)]
    n, runs, rate = len(groups), 400, 0.1
    error = rng.uniform(0.02, 0.3, n)
    alarms = 0
    for k in range(runs):
        value = rng.standard_normal(n) * np.hypot(0.1, error) + np.repeat(
            rng.standard_normal(len(sizes)), sizes)
        alarms += outliers(value, error, groups, rate, seed=k, simulations=300).found.any()
    # Binomial error, and that of a quantile of 300 simulations; four of them.
    spread = math.sqrt(rate * (1 - rate) * (1 / runs + 1 / 300 / 20)) + 0.01
    assert abs(alarms / runs - rate) < 4.0 * spread


def test_outliers_are_found():
    rng = np.random.default_rng(4)
    groups = ['a'] * 20 + ['b'] * 20
    hits = others = 0
    for k in range(100):
        value = 0.1 * rng.standard_normal(40)
        value[7] += 0.6 * rng.choice((-1, 1))
        found = outliers(value, np.full(40, 0.03), groups, OUTLIER_RATE, seed=k,
                         simulations=500).found
        hits += found[7]
        others += found.any() and not (found.sum() == 1 and found[7])
    # 0.6 / hypot(0.1, 0.03) is 5.7; the bound is near 3.6: missed with chance 2 % by the normal
    # law; of 100 fleets 90 are four standard deviations below what is expected of that.
    assert hits >= 90
    assert others <= 5 + 4 * math.sqrt(100 * 0.05 * 0.95)


def test_small_groups_and_unknown_vehicles_are_not_judged():
    """No score, no alarm, however far off they are."""
    value = np.array([0.0, 100.0, 0.0, 1.0, -1.0, 0.5, 50.0])
    found = outliers(value, np.zeros(7), ['a', 'a', 'a', '', '', '', ''], 0.05)
    assert np.isnan(found.score).all() and not found.found.any()
    # Values that do not scatter at all are no division by zero.
    assert not outliers(np.ones(8), np.zeros(8), ['a'] * 8, 0.05, simulations=50).found.any()


@pytest.mark.parametrize('flights', [3, 4, 9])
@pytest.mark.parametrize('scatter', [0.0, 0.05, 0.3])
def test_the_interval_of_a_line_holds_the_truth(flights, scatter):
    rng = np.random.default_rng(12)
    x, runs, held = np.arange(1.0, flights + 1.0), 400, 0
    for _ in range(runs):
        error = rng.uniform(0.03, 0.1, flights)
        y = 1.0 + 0.1 * x + np.hypot(error, scatter) * rng.standard_normal(flights)
        slope, _, se = weighted_line(x, y, error)
        held += abs(slope - 0.1) <= stats.t.ppf(0.975, flights - 2) * se
    # With one degree of freedom the weights are hardly known: a percent or two too few.
    assert held / runs == pytest.approx(0.95, abs=4.0 * math.sqrt(0.95 * 0.05 / runs))


def test_a_line_without_scatter_is_exact():
    x = np.arange(1.0, 5.0)
    slope, start, se = weighted_line(x, 2.0 - 0.5 * x, np.zeros(4))
    assert (slope, start) == (pytest.approx(-0.5), pytest.approx(2.0)) and se < 1e-12


def test_drift_keeps_its_rate():
    """Fleets without drift show one in at most as many as stated, from three flights on."""
    rng = np.random.default_rng(5)
    runs = 100
    for flights in (LEAST_FLIGHTS, 9):
        alarms = 0
        for _ in range(runs):
            rows = table(rng, 5, flights, levels=LEVELS[:1])
            tested = trends([values_of(rows, name) for name in QUANTITIES])
            assert len(tested) == 5 * len(QUANTITIES)
            alarms += any(t.p_family <= DRIFT_RATE for t in tested)
        # Holm bounds the rate: one-sided.
        assert alarms / runs < DRIFT_RATE + 3.0 * math.sqrt(DRIFT_RATE * (1 - DRIFT_RATE) / runs)
    assert not trends([values_of(table(rng, 5, 2), name) for name in QUANTITIES])


def test_growth_per_month_needs_dates_a_month_apart():
    """The line over the dates, fitted as the one over the flights."""
    rng = np.random.default_rng(3)
    rows = table(rng, 1, 6, levels=LEVELS[:1])
    days = [0, 20, 61, 122, 140, 240]
    for apart, known in ((1.0, True), (1.0, False), (0.1, True)):
        dated = [{**row, 'start': datetime(2026, 1, 1, tzinfo=timezone.utc) + timedelta(
            apart * days[row['flight'] - 1])} for row in rows]
        if not known:
            dated[2]['start'] = None
        for name in OF_PACK:
            values = values_of(dated, name)
            (found,) = trends([values])
            if apart < 1.0 or not known:
                assert np.isnan(found.monthly).all()
                continue
            slope, _, se = weighted_line(np.array(days) / 30.4375, values.value, values.error)
            reach = stats.t.ppf(0.975, 4) * se
            assert found.monthly == pytest.approx((slope, slope - reach, slope + reach))


def test_an_ageing_pack_is_found():
    """10 % a flight in seven flights, beside four healthy packs; its interval holds the truth."""
    rng = np.random.default_rng(13)
    runs, rate = 40, math.log(1.1)
    # Error of the slope; power of a t test with 5 degrees of freedom at the level of Holm's first.
    se = PACK / math.sqrt(28.0)
    bar = stats.t.isf(0.5 * DRIFT_RATE / (5 * len(QUANTITIES)), 5)
    power = stats.nct.sf(bar, 5, rate / se)
    assert power > 0.9
    found = dict.fromkeys(OF_PACK, 0)
    others = held = 0
    for _ in range(runs):
        judged = judge(table(rng, 5, 7, levels=LEVELS[:1], ageing={1: rate}))
        mine = [t for t in judged.drifting if t.vehicle == 'uav1' and t.quantity in OF_PACK]
        for t in mine:
            found[t.quantity] += 1
        held += sum(t.low <= rate <= t.high for t in judged.trends
                    if t.vehicle == 'uav1' and t.quantity in OF_PACK)
        others += len(judged.drifting) > len(mine)
    spread = math.sqrt(power * (1 - power) / runs)
    assert all(count / runs > power - 4.0 * spread - 0.02 for count in found.values())
    assert others <= runs * DRIFT_RATE + 3.0 * math.sqrt(runs * DRIFT_RATE)
    assert held / (2 * runs) == pytest.approx(0.95, abs=4.0 * math.sqrt(0.95 * 0.05 / (2 * runs)))


@pytest.mark.parametrize('vehicles', [2, 3, 5])
def test_a_few_vehicles_are_compared_by_their_flights(vehicles):
    """Below six: 9 % more is no alarm, 40 % more resistance is found; not with other packs."""
    rng = np.random.default_rng(14)
    runs, alarms, hits, beside = 25, 0, 0, 0
    for _ in range(runs):
        alarms += bool({name for name, _ in judge(
            table(rng, vehicles, 5, levels=LEVELS[:1], ohms={0: math.log(1.09)})
            ).odd_vehicles()} & {*OF_PACK})
        judged = judge(table(rng, vehicles, 5, levels=LEVELS[:1], ohms={1: math.log(1.4)}))
        odd = {(name, judged.vehicles[name].names[k]) for name, k in judged.odd_vehicles()}
        # Of two, the lower one is not told again.
        hits += ('resistance', 'uav1') in odd
        # The odd pack does not make the good ones look odd.
        beside += any(name in OF_PACK and vehicle != 'uav1' for name, vehicle in odd)
    assert beside / runs < OUTLIER_RATE + 3.0 * math.sqrt(OUTLIER_RATE / runs)
    assert alarms / runs < OUTLIER_RATE + 3.0 * math.sqrt(OUTLIER_RATE / runs)
    # 0.24 more than a tenth is at least 7.6 errors of the difference, 0.05 * sqrt(2 / 5); the bar
    # is 3.6 with 8 degrees of freedom: missed with chance 1e-3.
    assert hits >= runs - 1
    mixed = table(rng, vehicles, 5, levels=LEVELS[:1], ohms={1: math.log(1.4)})
    for row in mixed:
        row['cells'] = 4 + int(row['vehicle'][3:])
    assert not judge(mixed).odd_vehicles()


def test_drift_and_outliers_are_told_apart():
    rng = np.random.default_rng(6)
    right = slopes = 0
    for _ in range(8):
        judged = judge(table(rng, 20, 10, drift={2: 0.08}, odd_vehicles={4: 2.0},
                             odd_flights={(6, 3): 0.9}))
        trend = next((t for t in judged.drifting if t.vehicle == 'uav2'), None)
        flights = {(q, judged.values[q].paths[k]) for q, k in judged.odd_recordings()}
        vehicles = {(q, judged.vehicles[q].names[k]) for q, k in judged.odd_vehicles()}
        right += (len(judged.drifting) == 1 and trend is not None
                  and flights == {('sigma', '/f/uav6/3')} and vehicles == {('sigma', 'uav4')})
        slopes += trend is not None and trend.low <= 0.08 <= trend.high
    # Effects of 8 to 13 standard deviations are always seen; a false alarm beside them has a
    # chance of at most 5 % + 5 %: of 8 fleets, 5 have one with chance 4e-4.
    assert right >= 4
    # 95 % intervals: fewer than 5 of 8 hold the truth with chance 4e-4.
    assert slopes >= 5
