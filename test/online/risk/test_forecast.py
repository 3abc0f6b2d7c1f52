"""Risk with future throttle, and the budget: simulated pilots and packs, without the package."""

from copy import copy, deepcopy
from functools import cache
import math
from pathlib import Path

import numpy as np
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.first_passage import brownout_probability
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.risk.forecast import Forecast, throttle_budget
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, Status
from ou_monitor.timeline import Batch
from project import ROOT
from pushed import pushed
import pytest
from scipy.signal import lfilter


RATE, SECONDS, FLOWN = 50.0, 80.0, 3000
DT = 1.0 / RATE
# As long as a horizon: looks that overlap would say no more.
LOOK = round(1.0 * RATE)


def batch(t, v):
    return Batch(np.stack((t, v, *np.full((2, t.size), math.nan))), restart=False)


def telegraph(rng, n):
    """Return throttle that ramps, in 0.2 s, to a new place about once a second."""
    wanted = np.empty(n)
    k = 0
    while k < n:
        end = k + 1 + int(rng.exponential(RATE))
        wanted[k:end] = rng.uniform(0.1, 0.9)
        k = end
    return lfilter(np.full(10, 0.1), 1.0, wanted - wanted[0]) + wanted[0]


def steps(rng, n):
    """Return throttle that is set every two to nine seconds, at once."""
    out = np.empty(n)
    k = 0
    while k < n:
        end = k + int(rng.uniform(2.0, 9.0) * RATE)
        out[k:end] = rng.uniform(0.15, 0.9)
        k = end
    return out


def recorded(_, n):
    t, u = np.loadtxt(Path(ROOT) / 'bags/recorded/gecko.csv', delimiter=',', skiprows=1,
                      usecols=(0, 2)).T
    return np.interp(5.0 + np.arange(n) * DT, t - t[0], u)


PILOTS = {'telegraph': telegraph, 'steps': steps, 'recorded': recorded}


class Pack:
    """Sag of x = u^1.8 at once, after 60 ms and after 2 s; discharge; white noise."""

    def __init__(self, u):
        x = u[0] ** 1.8
        self.fast, self.slow, self.level = x, x, 16.2

    def volts(self, u, noise):
        """Return the voltage under a throttle, sample by sample."""
        out = np.empty(u.size)
        for k, x in enumerate(u ** 1.8):
            self.fast += (x - self.fast) * -math.expm1(-DT / 0.06)
            self.slow += (x - self.slow) * -math.expm1(-DT / 2.0)
            self.level -= 0.004 * x * DT
            out[k] = self.level - 0.6 * x - 0.9 * self.fast - 0.5 * self.slow
        return out + 0.04 * noise


@cache
def flight(pilot, seed=1):
    """Return throttle, voltage, and the pack after `FLOWN` samples."""
    rng = np.random.default_rng(seed)
    u = PILOTS[pilot](rng, round(SECONDS * RATE))
    noise = rng.standard_normal(u.size)
    pack = Pack(u)
    first = pack.volts(u[:FLOWN], noise[:FLOWN])
    then = copy(pack)
    return u, np.concatenate((first, pack.volts(u[FLOWN:], noise[FLOWN:]))), then


def middle_of(v):
    return np.median(np.stack((v[:-2], v[1:-1], v[2:])), axis=0)


@cache
def asked(pilot, horizon=1.0):
    """Return published and conditional risks at three levels, and what happened; (n, 3) each."""
    u, v, _ = flight(pilot)
    ahead = round(horizon * RATE)
    middle = np.concatenate((v[:2], middle_of(v)))
    looks = np.arange(LOOK - 1, u.size - ahead, LOOK)
    lows = np.array([middle[k + 1:k + 1 + ahead].min() for k in looks])
    late = looks > 20.0 * RATE
    levels = np.quantile(lows[late], (0.02, 0.1, 0.3)).tolist()
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=levels[1], brownout_horizon=horizon,
                                            brownout_floor=0.0))
    risks, conditional, bases = [], [], []
    for k in looks:
        part = slice(k + 1 - LOOK, k + 1)
        monitor.push((k + 1 - LOOK + np.arange(LOOK)) * DT, v[part], u[part])
        bases.append(monitor.report(0.0).risk_basis)
        peak = u[k + 1:k + 1 + ahead].max()
        dwell = (u[k + 1:k + 1 + ahead] >= peak - 0.05).sum() * DT
        risks.append([monitor.risk(level, horizon) for level in levels])
        conditional.append([monitor.risk_if(peak, dwell, level, horizon) for level in levels])
    happened = lows[:, None] < np.array(levels)
    return (np.array(risks)[late], np.array(conditional)[late], happened[late].astype(float),
            [basis for basis, counts in zip(bases, late) if counts])


@pytest.mark.parametrize('pilot', list(PILOTS))
def test_as_many_dips_happen_as_are_told(pilot):
    """
    As many dips as told, within 2.6 deviations and a factor of 1.5, in each third of the risk.

    Horizons of 1 s, one after another: the variance is the binomial one.
    """
    risks, conditional, happened, bases = asked(pilot)
    assert bases.count('load') > 0.9 * len(bases)
    for said in (risks, conditional):
        assert np.isfinite(said).all()
        for low, high in ((0.0, 0.05), (0.05, 0.3), (0.3, 1.01)):
            inside = (said >= low) & (said < high)
            told = said[inside].sum()
            spread = 2.6 * math.sqrt(float((said[inside] * (1.0 - said[inside])).sum()))
            assert told / 1.5 - spread - 2.0 < happened[inside].sum() < 1.5 * told + spread + 2.0


@pytest.mark.parametrize('pilot, least', [('telegraph', 0.6), ('recorded', 0.5)])
def test_the_condition_tells_more_than_the_flight(pilot, least):
    """Brier skill against the mean frequency, and far above that of the risk with the pilot."""
    risks, conditional, happened, _ = asked(pilot)
    base = np.mean((happened.mean(axis=0) - happened) ** 2)
    skill, without = (1.0 - np.mean((said - happened) ** 2) / base
                      for said in (conditional, risks))
    assert skill > least and skill > without + 0.2


def monitor_of(**changes):
    """Return a monitor that has flown, and the time, s."""
    monitor = deepcopy(_flown())
    monitor.configure(MonitorSettings(**{
        'brownout_voltage': 14.6, 'brownout_horizon': 2.0, 'brownout_floor': 0.0, **changes}))
    return monitor, FLOWN * DT


@cache
def _flown():
    u, v, _ = flight('telegraph')
    monitor = SupplyMonitor(MonitorSettings())
    for part in np.array_split(np.arange(FLOWN), FLOWN // 100):
        monitor.push(part * DT, v[part], u[part])
    return monitor


def test_flying_at_the_budget_dips_as_often_as_told():
    """400 flights from the same pack at a budget of 10 %, held for the horizon."""
    # 0.05 of throttle is 0.1 V, more than two deviations of the noise: less than 10 % dip below
    # the budget, more above it.
    u, v, pack = flight('telegraph')
    rng = np.random.default_rng(3)
    monitor, _ = monitor_of(brownout_voltage=14.75, brownout_budget_limit=0.1,
                            brownout_critical=0.2)
    report = monitor.report(0.0)
    assert report.risk_basis == 'load' and 0.3 < report.budget < 0.85
    assert 'The risk passes the limit of 0.1' in report.budget_reason
    assert monitor.risk_if(report.budget, 2.0) == pytest.approx(0.1, abs=0.01)

    def dips(throttle):
        ahead = np.full(100, throttle)
        ahead[:10] = np.linspace(u[FLOWN - 1], throttle, 11)[1:]
        again = copy(pack)
        noisy = again.volts(ahead, 0.0) + 0.04 * rng.standard_normal((400, 100))
        low = np.median(np.stack((noisy[:, :-2], noisy[:, 1:-1], noisy[:, 2:])), axis=0)
        return float((low.min(axis=1) < 14.75).mean())
    assert dips(report.budget - 0.05) < 0.1 < dips(report.budget + 0.05)


def test_a_quarter_of_the_sag_leaves_a_quarter_of_its_errors():
    """The drops that the law missed in this flight came from its sag, and shrink with it."""
    monitor, _ = monitor_of()
    assert monitor.changed_risk(1.0, 1.0, 14.6)[-1] > 0.3
    # The mean stays a volt, 25 deviations of the noise, above the limit.
    assert monitor.changed_risk(0.25, 1.0, 14.6)[-1] < 1e-4


def test_asking_changes_nothing_and_is_quick():
    monitor, _ = monitor_of()
    first = monitor.risk(14.8, 1.0), monitor.risk_if(0.8, 0.5, 14.8, 1.0)
    report = monitor.report(0.0)
    for voltage, horizon in ((12.0, 0.1), (15.0, 60.0), (14.0, 5.0)):
        monitor.risk(voltage, horizon)
        monitor.risk_if(0.3, 1.0, voltage, horizon)
    assert (monitor.risk(14.8, 1.0), monitor.risk_if(0.8, 0.5, 14.8, 1.0)) == first
    assert monitor.report(0.0).risk == report.risk == monitor.risk()
    # Nor do reports between two samples.
    u, v, _ = flight('telegraph')
    often, once = monitor_of()[0], monitor_of()[0]
    for k in range(FLOWN, FLOWN + 30):
        often.push(k * DT, v[k], u[k])
        often.report(0.0)
    part = slice(FLOWN, FLOWN + 30)
    once.push(np.arange(FLOWN, FLOWN + 30) * DT, v[part], u[part])
    assert once.report(0.0).budget == pytest.approx(often.report(0.0).budget, rel=1e-9)
    assert report.risk_curve[0] < report.risk_curve[-1]
    assert report.fields['risk_basis'] == 'load' and '1.0:' in report.fields['risk_curve']


@pytest.mark.parametrize('horizon', [0.1, 0.3, 1.0, 3.0, 10.0, 60.0])
def test_risk_is_a_probability_at_any_horizon(horizon):
    """Known from 0.1 to 60 s, within 0..1, falling with the margin."""
    monitor, _ = monitor_of()
    risks = [monitor.risk(voltage, horizon) for voltage in (15.0, 14.0, 13.0, 10.0)]
    held = [monitor.risk_if(0.7, 0.5, voltage, horizon) for voltage in (15.0, 14.0, 13.0, 10.0)]
    for found in (risks, held):
        assert all(0.0 <= risk <= 1.0 for risk in found)
        assert all(np.diff(found) <= 0.0)


def test_a_longer_horizon_is_no_safer():
    """Within the errors of two laws: a tenth of the risk."""
    monitor, _ = monitor_of()
    risks = [monitor.risk(14.6, horizon) for horizon in (0.1, 0.5, 2.0, 10.0)]
    assert all(b > 0.9 * a for a, b in zip(risks, risks[1:]))


def test_a_limit_above_the_present_voltage():
    monitor, _ = monitor_of()
    assert monitor.risk(17.0, 1.0) == 1.0 and monitor.risk_if(0.9, 1.0, 17.0, 1.0) == 1.0
    assert monitor.risk_if(0.0, 1.0, 17.0, 1.0) > 0.999


def test_less_throttle_brings_a_rail_back_above_the_limit():
    """Held at 0.9, 0.25 V below a limit; at 0.2 the rail is 0.46 V higher at once: 3 flights."""
    budgets = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = np.append(steps(rng, FLOWN), np.full(100, 0.9))
        v = Pack(u).volts(u, rng.standard_normal(u.size))
        limit = float(np.median(v[-50:])) + 0.25
        monitor = SupplyMonitor(MonitorSettings(brownout_voltage=limit, brownout_horizon=1.0))
        pushed(monitor, np.arange(u.size) * DT, v, u, size=100)
        report = monitor.report(0.0)
        assert report.risk == 1.0 and monitor.risk_if(0.9, 1.0) == 1.0
        assert monitor.risk_if(0.9, 0.5) == 1.0 and monitor.risk_if(0.2, 1.0) < 0.2
        budgets.append(report.budget)
    # From 0.61 on the rail stays below the limit at first; errors of the model cost the rest.
    assert 0.0 < np.median(budgets) and max(budgets) < 0.61


@pytest.mark.parametrize('arguments, words', [
    ((math.nan, 1.0), 'voltage must be finite'), ((14.0, 0.0), 'horizon must be a positive'),
    ((14.0, -1.0), 'horizon must be a positive'), ((14.0, math.inf), 'horizon must be')])
def test_what_cannot_be_asked(arguments, words):
    monitor, _ = monitor_of()
    with pytest.raises(ValueError, match=words):
        monitor.risk(*arguments)
    with pytest.raises(ValueError, match='throttle must lie within 0..1'):
        monitor.risk_if(1.2, 1.0, 14.0, 1.0)
    with pytest.raises(ValueError, match='dwell'):
        monitor.risk_if(0.5, -1.0, 14.0, 1.0)


def test_throttle_is_lost_and_found():
    monitor, t = monitor_of()
    _, v, _ = flight('telegraph')
    bases = []
    for k in range(60):
        at = t + np.arange(10) * DT
        t = at[-1] + DT
        known = k < 5 or k >= 35
        monitor.push(at, v[3000 + 10 * k:3010 + 10 * k], flight('telegraph')[0][
            3000 + 10 * k:3010 + 10 * k] if known else math.nan)
        report = monitor.report(0.0)
        assert math.isfinite(report.risk)
        bases.append(report.risk_basis)
    assert bases[4] == 'load' and bases[20] == 'excursions'
    assert math.isnan(monitor.risk_if(0.5, 1.0)) == (bases[-1] == 'excursions')


def test_voltage_is_lost_in_a_dip():
    """The risk of the last voltage stays until it is stale; then nothing is known."""
    monitor, t = monitor_of(brownout_voltage=15.4)
    at = t + np.arange(10) * DT
    monitor.push(at, np.full(10, 15.0), 0.9)
    assert monitor.report(0.0).risk == 1.0
    monitor.push(at + 0.2, np.full(10, math.nan), 0.9)
    assert monitor.report(0.2).risk == 1.0
    late = monitor.report(5.0)
    assert math.isnan(late.risk) and late.brownout is not False


def test_another_battery_is_learned_within_seconds():
    """A pack 1 V higher: the risk is known at once, and small again within seconds."""
    monitor, t = monitor_of(brownout_voltage=14.6)
    u, v, _ = flight('telegraph')
    for k in range(100):
        at = t + np.arange(10) * DT
        t = at[-1] + DT
        monitor.push(at, v[3000 + 10 * k:3010 + 10 * k] + 1.0, u[3000 + 10 * k:3010 + 10 * k])
        assert math.isfinite(monitor.report(0.0).risk)
    assert monitor.report(0.0).load.level == pytest.approx(
        17.2 - 0.004 * 0.35 * 80.0, abs=0.4)
    assert monitor.risk_if(0.3, 1.0, 14.0, 1.0) < 0.01


def test_known_from_the_first_second_and_flag_hardly_unknown():
    _, v, _ = flight('telegraph')
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=13.0, brownout_floor=0.0))
    for k in range(200):
        part = slice(10 * k, 10 * k + 10)
        monitor.push((10 * k + np.arange(10)) * DT, v[part], 0.5)
        report = monitor.report(0.0)
        if k > 6:
            assert math.isfinite(report.risk) and report.flag.level is not FlagLevel.UNKNOWN
    assert report.risk_basis == 'excursions'
    assert math.isnan(report.budget) and 'moved by less than' in report.budget_reason


def estimated(u0, deviation, alpha):
    return Estimate(alpha=alpha, sigma=deviation * math.sqrt(2.0 * alpha), var_inf=deviation ** 2,
                    u0=u0, alpha_se=0.0, sigma_se=0.0, var_inf_se=0.0, u0_se=0.0, rate=RATE,
                    status=Status.OK)


def test_first_passage_has_most_of_the_weight():
    """Nine tenths before any horizon is complete."""
    _, v, _ = flight('telegraph')
    forecast = Forecast(LoadFilter())
    forecast.take(batch(np.arange(300) * DT, v[:300]))
    far = forecast.risk(15.0, 1.0)
    assert far.basis == 'excursions' and 0.0 < far.risk < 1.0
    forecast.follow(estimated(15.2, 0.1, 5.0), 2.0)
    passage = brownout_probability(forecast.estimate, 15.0, 1.0, forecast.voltage)
    assert 0.1 < passage < 1.0
    both = forecast.risk(15.0, 1.0)
    assert both.basis == 'first_passage'
    assert both.risk == pytest.approx(0.9 * passage + 0.1 * far.risk)


@pytest.mark.parametrize('wrong', [False, True])
def test_the_leg_that_predicts_better_stands(wrong):
    """A first passage four deviations too high is left within a minute; a true one stays."""
    rng = np.random.default_rng(4)
    v = 15.0 + lfilter([0.1], [1.0, -0.9], rng.standard_normal(3000))
    # alpha = -50 ln 0.9; the deviation is 0.1 / sqrt(1 - 0.81).
    deviation = 0.1 / math.sqrt(0.19)
    forecast = Forecast(LoadFilter())
    forecast.follow(estimated(15.0 + 4.0 * deviation * wrong, deviation, -RATE * math.log(0.9)),
                    2.0)
    for k in range(0, 3000, 10):
        forecast.take(batch((k + np.arange(10)) * DT, v[k:k + 10]))
    assert forecast.risk(14.0, 1.0).basis == ('excursions' if wrong else 'first_passage')


GRID = np.linspace(0.0, 1.0, 51)


def budget(risks, limit=1e-2, highest=0.9):
    return throttle_budget(np.asarray(risks), np.linspace(0.0, highest, 9), limit)


@pytest.mark.parametrize('limit', [1e-6, 1e-4, 1e-3, 1e-2, 0.1])
def test_the_budget_is_where_the_risk_passes_the_limit(limit):
    """A logarithm that is straight over throttle is interpolated exactly."""
    throttle, reason = budget(np.exp(20.0 * (GRID - 1.0)), limit)
    end = 1.0 + math.log(limit) / 20.0
    assert throttle == pytest.approx(min(end, 0.9))
    assert f'{limit:.2g}' in reason or end > 0.9


def test_the_edge_of_the_flight_is_no_claim_of_safety():
    """Flown up to 0.4 only, where the risk is small: the budget ends there and says why."""
    throttle, reason = budget(np.full(51, 1e-9), highest=0.4)
    assert throttle == 0.4 and 'No data above 0.40' in reason
    assert budget(np.full(51, 1e-9), highest=1.0)[0] == 1.0


def test_nothing_is_interpolated_across_a_switch():
    """On or off, 2 V apart: the limit between them is none that a throttle of 0.5 was seen at."""
    u = np.repeat(np.random.default_rng(2).integers(0, 2, 60), 50).astype(float)
    u[-25:] = 0.0
    v = 16.0 - 2.0 * u + 0.03 * np.random.default_rng(3).standard_normal(u.size)
    for limit, most in ((15.0, 0.0), (12.0, 1.0)):
        monitor = SupplyMonitor(MonitorSettings(brownout_voltage=limit))
        report = pushed(monitor, np.arange(u.size) * DT, v, u, size=25).report(0.0)
        assert report.budget == most and ('No data between 0.00 and 1.00' in report.budget_reason
                                          ) == (most < 1.0)


@pytest.mark.parametrize('at', [0.2, 0.5, 0.8])
def test_a_risk_that_falls_again_is_no_way_through(at):
    risks = np.where(np.abs(GRID - at) < 0.05, 0.5, 1e-6)
    assert at - 0.08 <= budget(risks)[0] <= at - 0.02


def test_above_the_limit_from_the_start():
    throttle, reason = budget(np.full(51, 0.3))
    assert throttle == 0.0 and 'idle' in reason


def test_dips_that_throttle_does_not_tell_are_counted():
    """Beside full throttle something else takes 4 V for 0.1 s every 6 s."""
    # Of the horizons of 2 s up to a third fall below 9 V (said: 0.045; without these misses 3e-5).
    t = np.arange(5900) / 50.0
    u = np.where(t % 10.0 < 3.0, 0.0, 1.0)
    v = 14.0 - 2.0 * u + 0.03 * np.random.default_rng(5).standard_normal(t.size)
    v[(t % 6.0 > 5.9) & (u > 0.0)] -= 4.0
    settings = MonitorSettings(brownout_voltage=9.0, brownout_horizon=2.0)
    monitor = pushed(SupplyMonitor(settings), t, v, u, size=10)
    assert 0.02 < monitor.risk_if(1.0, 2.0, 9.0, 2.0) < 0.5


def test_the_risk_does_not_fall_with_the_horizon():
    """A load of 0.8 s each 1.6 s takes the voltage below the limit every time."""
    t = np.arange(4000) / 100.0
    u = (t % 1.6 >= 0.8).astype(float)
    v = 12.05 - 0.11 * u + (0.005 + 0.005 * u) * np.random.default_rng(3).standard_normal(t.size)
    settings = MonitorSettings(brownout_voltage=11.94, brownout_horizon=5.0)
    monitor = pushed(SupplyMonitor(settings), t, v, u, size=20)
    risks = [float(monitor.risk_if(1.0, h, 11.94, h)) for h in (1.0, 2.0, 5.0)]
    assert risks == sorted(risks) and risks[0] > 0.5


def test_the_risk_curve_rises_with_throttle():
    """At full throttle a step down is an extrapolation, of which idle must not seem riskier."""
    rng = np.random.default_rng(2)
    t = np.arange(9000) / 200.0
    u = np.repeat(rng.uniform(0.05, 0.8, 30), 300)
    v = 5.0 - 0.2 * u**1.8 + (0.01 + 0.05 * u) * rng.standard_normal(t.size)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=4.6, brownout_horizon=5.0))
    for k in range(0, t.size, 100):
        monitor.push(t[k:k + 100], v[k:k + 100], u[k:k + 100])
        curve = monitor.report(0.0).risk_curve
        assert list(curve) == sorted(curve)


def test_idling_is_not_charged_with_the_punches_of_the_flight():
    """Idle is 1.4 V above the limit; the excursions of the flight alone would make it 0.004."""
    t = np.arange(6000) / 100.0
    u = np.where(t % 5.0 < 4.5, 0.3 + 0.05 * np.sin(t), 0.9)
    v = 16.0 - 3.0 * u**1.8 + 0.02 * np.random.default_rng(5).standard_normal(t.size)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=14.5, brownout_horizon=2.0))
    risks = []
    for k in range(0, t.size, 20):
        monitor.push(t[k:k + 20], v[k:k + 20], u[k:k + 20])
        if t[k] > 30.0 and v[k + 19] > 15.0:
            risks.append(monitor.risk_if(0.0, 2.0, 14.5, 2.0))
    assert max(risks) < 0.001
    # A punch, which the flight has shown, is not safe.
    assert monitor.risk_if(0.9, 0.5, 14.5, 2.0) > 0.5


def test_gusts_do_not_hide_the_fall_of_a_throttle_that_is_held():
    """
    A hover in gusts, then 70 % for 2 s: likely 0.3 V above the true lowest, unlikely 0.1 V below.

    Throttle within 5 % of the highest counts as its peak, so falls come out too deep by a few per
    cent of throttle.  When the law could only take that for its gain, the risk was 0.63 to 0.91.
    """
    for seed in range(2):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 100.0, 0.02)
        gust = np.interp(t, 0.3 * np.arange(1001), rng.standard_normal(1001))
        u = np.clip(0.45 + 0.06 * gust + 0.03 * rng.standard_normal(t.size), 0.0, 1.0)
        monitor = SupplyMonitor(MonitorSettings(brownout_voltage=12.0))
        monitor.push(t, 15.0 - 3.0 * u ** 1.8 + 0.02 * rng.standard_normal(t.size), u)
        low = 15.0 - 3.0 * 0.7 ** 1.8 - 0.03
        above, below = (monitor.risk_if(0.7, 2.0, low + by, 2.0) for by in (0.3, -0.1))
        assert above > 0.9 and below < 0.1
