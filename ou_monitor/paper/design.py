"""
Find the bulk capacitance that brings the brown-out risk of a rail under a target.

Limits: a linear network with Gaussian noise (see `ou_monitor.paper.network`), constant throttle,
ideal capacitors of one series, no ageing or cold.  The risk is the larger of two risks.  The first
comes from the exact mean first passage of an OU with the slowest excited pole and the variance of
the rail; the second from the high-level crossing rate of the whole Gaussian process.  In
simulations with levels at 2.5 and 3.2 standard deviations (extrapolated to a time step of 0), the
first was 60 times too low (noise through a large ESR) to 4 times too high (no ESR), the second 1.1
to 3 times too high.

Once C is large enough that the network is slower than the noise, both risks fall as C rises. Below
that C, the second rose by a factor of up to 1.44 in 39 of 6000 random networks.

`network_of` chooses components that reproduce a flight; doc/theory.md says how its risks are
computed. Limits: sag and noise are as measured, including the white noise and the filter of the
sensor. Noise added by changes of throttle, and an OU if one was found, count as slow fluctuations
of the current, which capacitors on a board do not change; the rest of the noise is attributed to
the switching of the ESCs. Without a measured current, the resistance is the given or default one,
and the current is scaled to fit the sag. The effect of packs in parallel is then still right, but
the effect of an ESR is uncertain.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
import enum
import math
from typing import Any

import numpy as np
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.online.settings import DEFAULT_LIMIT, RAIL
from ou_monitor.paper.network import completed, PowerNetwork, Rail, rail_at
from ou_monitor.records import FloatArray
from ou_monitor.text import number, percent
from scipy.integrate import quad_vec
from scipy.special import ndtr

CELL_BROWNOUT = 3.3  # Brown-out level of a LiPo cell, V
# Range of a rail, V -> (brown-out level, V, source); 3.3 V +- 0.3 V by JEDEC JESD8C.
RAIL_BROWNOUT = {
    RAIL: (DEFAULT_LIMIT, 'lower limit of the 5 V rail in PX4'),
    (3.0, 3.6): (2.88, 'STM32F405 brown-out reset level 3, falling, highest (ST DS8626)')}
LEAST, MOST = 10e-6, 22e-3  # Range of capacitances, F
# Number of capacitances tried before the root is refined, because the risk may not be monotonic.
_GRID = 81
# Limits of the alternatives to capacitors: maximum packs in parallel, minimum share of the present
# resistance (new leads and a fresh pack), and of the present throttle.
_PACKS, _RESISTANCE, _THROTTLE = 3, 0.5, 0.5
# Range of the error of a mean, standard errors.
_FAR = 8.0
# Throttle, and factors on the sag and on the variance of the noise -> risk of a flight.
FlownRisk = Callable[[float, float, float], float]


class DesignVerdict(enum.Enum):
    """Verdict on a design; the value is its wording."""

    ENOUGH = 'the present capacitor is enough'
    FOUND = 'a capacitance in the range brings the risk under the target'
    OUT_OF_RANGE = 'no capacitance in the range brings the risk under the target'
    LEVEL = 'no capacitance helps: the mean is at or below the brown-out level'


@dataclass(frozen=True)
class DesignRow:
    """The rail with one capacitor."""

    # Bulk capacitor, F and Ohm.
    capacitance: float
    esr: float
    # Relaxation rate, 1/s, and time, s; NaN without noise.
    alpha: float
    tau: float
    # Intensity, V/sqrt(s), and stationary variance, V^2.
    sigma: float
    var_inf: float
    # Sag of the bus and mean of the rail, V; independent of the capacitor.
    sag: float
    mean: float
    # Mean time to brown-out of the OU from its mean, s; may be inf. If the mean has an error, this
    # is computed from `risk_ou`.
    mean_time: float
    crossing_rate: float  # High-level crossing rate of the whole process, 1/s.
    # Probability within the horizon, by mean first passage of the OU and by the crossing rate.
    risk_ou: float
    risk_crossing: float

    @property
    def risk(self) -> float:
        """Return the risk that decides: the larger of the two probabilities."""
        return max(self.risk_ou, self.risk_crossing)

    @property
    def rate(self) -> float:
        """Rate of brown-outs behind the larger probability, 1/s; may be inf."""
        slow = math.inf if self.mean_time == 0.0 else 1.0 / self.mean_time
        return max(slow, self.crossing_rate)


@dataclass(frozen=True)
class Lever:
    """One change of the craft, and the risk after it."""

    name: str  # What is changed.
    unit: str  # Unit of the values as shown.
    present: float
    tried: float  # A value that is easy to get.
    risk: float  # Risk with the value tried.
    # Value after the smallest change that meets the target (the present value if it already does);
    # NaN: out of reach.
    least: float

    def words(self, value: float) -> str:
        return number(value) if self.unit else f'{value:g}'


@dataclass(frozen=True)
class Design:
    """The result for one network, throttle and target."""

    network: PowerNetwork  # Components.
    rail: str  # ``bus`` or ``regulated``.
    throttle: float  # 0..1.
    # Brown-out level, V, time, s, and the risk allowed.
    voltage: float
    horizon: float
    target: float
    esr_follows: bool  # Whether ESR falls as 1/C (capacitors in parallel).
    verdict: DesignVerdict  # Verdict.
    present: DesignRow  # With the present capacitor.
    # With the smallest capacitance above which every capacitance meets the target; None: none
    # does, or all do and the present one too.
    least: DesignRow | None
    rows: tuple[DesignRow, ...]  # One row for each capacitance tried, rising.
    falls: bool  # Whether the risk never rises with capacitance in the table.
    levers: tuple[Lever, ...]  # More capacitance and its alternatives.
    sag_error: float = 0.0  # Standard error of the sag of the bus, relative.
    assumed: bool = False  # Whether the battery resistance is assumed, and so shown in %


def default_voltage(cells: int, rail: float) -> tuple[float, str]:
    """Return the brown-out level, V, of a pack or (if cells is 0) of a rail, and its source."""
    if cells:
        return CELL_BROWNOUT * cells, f'{CELL_BROWNOUT} V per LiPo cell'
    for (low, high), level in RAIL_BROWNOUT.items():
        if low <= rail <= high:
            return level
    raise ValueError(f'there is no default brown-out voltage for a rail of {rail:.4g} V: give '
                     'one (--brownout-voltage)')


def with_capacitance(network: PowerNetwork, capacitance: float,
                     esr_follows: bool = True) -> PowerNetwork:
    """Return the network with another bulk capacitor (capacitance in F)."""
    ratio = network.bulk_capacitance / capacitance if esr_follows else 1.0
    return replace(network, bulk_capacitance=capacitance, bulk_esr=ratio * network.bulk_esr)


def row_of(rail: Rail, voltage: float, horizon: float, sag_error: float = 0.0) -> DesignRow:
    """Return the numbers of a rail (sag_error: standard error of the sag of the bus, relative)."""
    rates = _rates(rail, voltage)
    se = sag_error * rail.sag if rail.name == 'bus' else 0.0
    if se > 0.0:
        # Where the uncertain mean is below the voltage, the risk is 1; integrate over the rest.
        level = (voltage - rail.mean) / se
        risks, _ = quad_vec(
            lambda z: -np.expm1(-horizon * _rates(rail, voltage - se * z)) * math.exp(
                -0.5 * z * z) / math.sqrt(2.0 * math.pi), min(max(level, -_FAR), _FAR), _FAR)
        rates = _rate_of(ndtr(level) + risks, horizon)
    net = rail.network
    slow, crossing = rates.tolist()
    risk_ou, risk_crossing = (-np.expm1(-horizon * rates)).tolist()
    return DesignRow(
        capacitance=net.bulk_capacitance, esr=net.bulk_esr, alpha=rail.alpha, tau=rail.tau,
        sigma=rail.sigma if rail.var_inf else 0.0, var_inf=rail.var_inf, sag=rail.sag,
        mean=rail.mean, mean_time=1.0 / slow if slow else math.inf, crossing_rate=crossing,
        risk_ou=risk_ou, risk_crossing=risk_crossing)


def _rates(rail: Rail, voltage: float) -> FloatArray:
    """Return two rates of falls below a voltage, 1/s: mean passage of the OU, and crossing."""
    if rail.mean <= voltage:
        return np.full(2, math.inf)
    if rail.var_inf == 0.0:
        return np.zeros(2)
    barrier = (rail.mean - voltage) / math.sqrt(rail.var_inf)
    return np.array([1.0 / (mean_first_passage(0.0, barrier) * rail.tau),
                     rail.crossing_rate(voltage)])


def _rate_of(risk: FloatArray, horizon: float) -> FloatArray:
    """Return the rate, 1/s, that gives a risk within a horizon, s."""
    return np.asarray(-np.log1p(-np.minimum(risk, 1.0 - 1e-16)) / horizon)


def design(
    network: PowerNetwork, throttle: float, *, voltage: float, horizon: float, risk: float,
    rail: str = 'bus', esr_follows: bool = True, capacitances: tuple[float, float] = (LEAST, MOST),
    sag_error: float = 0.0, flown: FlownRisk | None = None, assumed: bool = False,
) -> Design:
    """
    Find the minimum bulk capacitance that meets a brown-out risk (V, s, F).

    sag_error as in `row_of`, for a network without a flight; flown: the risk of a flight at this
    voltage and horizon, from which all rows and levers are then computed.
    """
    low, high = capacitances
    for name, value, unit in (('voltage', voltage, 'V'), ('horizon', horizon, 's'),
                              ('minimum capacitance', low, 'F'),
                              ('maximum capacitance', high, 'F')):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f'{name} must be positive and finite, got {value} {unit}')
    if not 0.0 < risk < 1.0:
        raise ValueError(f'risk must be between 0 and 1, both excluded, got {risk}')
    if low >= high:
        raise ValueError(f'the minimum capacitance must be below the maximum, got {low:g} F and '
                         f'{high:g} F')

    # The risk of a flight includes the error of the sag, and replaces the one computed here.
    error = 0.0 if flown is not None else sag_error
    own = row_of(rail_at(network, throttle, rail), voltage, horizon, error)

    def as_flown(row: DesignRow) -> DesignRow:
        if flown is None:
            return row
        found = flown(throttle, 1.0, row.var_inf / own.var_inf if own.var_inf > 0.0 else 1.0)
        rate = float(_rate_of(np.array(found), horizon))
        return replace(row, mean_time=1.0 / rate if rate else math.inf, crossing_rate=rate,
                       risk_ou=found, risk_crossing=found)

    present = as_flown(own)

    def at(capacitance: float) -> DesignRow:
        changed = with_capacitance(network, capacitance, esr_follows)
        return as_flown(row_of(rail_at(changed, throttle, rail), voltage, horizon, error))

    rows = [at(float(c)) for c in np.geomspace(low, high, _GRID)]
    least = None
    if present.mean <= voltage:
        verdict = DesignVerdict.LEVEL
    else:
        least = _least(at, rows, float(_rate_of(np.array(risk), horizon)))
        verdict = (DesignVerdict.ENOUGH if present.risk <= risk else
                   DesignVerdict.FOUND if least is not None else DesignVerdict.OUT_OF_RANGE)
        if verdict is DesignVerdict.ENOUGH and least is rows[0]:
            # The end of the range is not a minimum.
            least = None
    risks = [row.risk for row in rows]
    found = Design(
        network=network, rail=rail, throttle=throttle, voltage=voltage, horizon=horizon,
        target=risk, esr_follows=esr_follows, verdict=verdict, present=present, least=least,
        rows=tuple(rows), falls=all(b <= a * (1.0 + 1e-9) for a, b in zip(risks, risks[1:])),
        levers=(), sag_error=sag_error, assumed=assumed)
    return replace(found, levers=_levers(found, at, flown))


def _levers(found: Design, at: Callable[[float], DesignRow],
            flown: FlownRisk | None) -> tuple[Lever, ...]:
    network, throttle, target, least = found.network, found.throttle, found.target, found.least

    def risk(u: float, share: float = 1.0) -> float:
        # At a throttle, with a share of the resistance.
        if flown is not None:
            return flown(u, share, 1.0)
        changed = replace(network, battery_resistance=share * network.battery_resistance)
        try:
            return row_of(rail_at(changed, u, found.rail), found.voltage, found.horizon,
                          found.sag_error).risk
        except ValueError:
            # The battery cannot supply the load.
            return 1.0

    def resistance(share: float) -> float:
        # Less resistance cannot raise the risk; with the error of the level it may seem to.
        return min(risk(throttle, share), found.present.risk)

    def limit(share: float) -> float:
        return risk(share * throttle)

    bulk = network.bulk_capacitance
    unit, ohm = ('%', 100.0) if found.assumed else ('mOhm', 1e3 * network.battery_resistance)
    packs = next((n for n in range(1, _PACKS + 1) if resistance(1.0 / n) <= target), math.nan)
    source = 'battery and lead resistance' if network.cells else 'source resistance'
    return (
        Lever('bulk capacitance', 'uF', 1e6 * bulk, 2e6 * bulk, at(2.0 * bulk).risk,
              1e6 * bulk if found.present.risk <= target else
              math.nan if least is None else 1e6 * least.capacitance),
        *([Lever('packs in parallel', '', 1.0, 2.0, resistance(0.5), packs)]
          if network.cells else []),
        Lever(source, unit, ohm, 0.75 * ohm, resistance(0.75),
              ohm * _share(resistance, _RESISTANCE, target)),
        Lever('throttle limit', '%', 100.0 * throttle, 80.0 * throttle, limit(0.8),
              100.0 * throttle * _share(limit, 0.0 if flown is not None else _THROTTLE, target)))


def _bisect(meets: Callable[[float], bool], good: float, bad: float, width: float) -> float:
    """Return the value nearest to `bad`, within a width, that meets a target as `good` does."""
    while abs(bad - good) > width:
        middle = 0.5 * (good + bad)
        good, bad = (middle, bad) if meets(middle) else (good, middle)
    return good


def _share(risk: Callable[[float], float], least: float, target: float) -> float:
    """Return the largest share, `least` to 1, that meets the target; NaN if none does."""
    if risk(1.0) <= target:
        return 1.0
    if risk(least) > target:
        return math.nan
    return _bisect(lambda share: risk(share) <= target, least, 1.0, 1e-8)


def _least(at: Callable[[float], DesignRow], rows: list[DesignRow],
           allowed: float) -> DesignRow | None:
    """Return the first row such that all later ones are within the allowed rate, 1/s."""
    above = [k for k, row in enumerate(rows) if row.rate > allowed]
    if not above:
        return rows[0]
    if above[-1] == len(rows) - 1:
        return None
    low, high = (math.log(rows[k].capacitance) for k in (above[-1], above[-1] + 1))
    return at(math.exp(_bisect(
        lambda log: at(math.exp(log)).rate <= allowed, high, low, 1e-12)))


def as_data(result: Design, source: str, taken: str) -> dict[str, Any]:
    """Return the result for JSON; `taken` describes the values from a flight, if any."""
    def row(r: DesignRow | None) -> dict[str, float] | None:
        return None if r is None else {**asdict(r), 'risk': r.risk}

    return {
        'network': asdict(result.network), 'rail': result.rail, 'throttle': result.throttle,
        'brownout_voltage': result.voltage, 'brownout_voltage_source': source,
        'horizon_s': result.horizon, 'target_risk': result.target,
        'esr_follows': result.esr_follows, 'verdict': result.verdict.name.lower(),
        'answer': answer(result), 'present': row(result.present),
        'least': row(result.least), 'levers': [asdict(lever) for lever in result.levers],
        'risk_falls_with_capacitance': result.falls,
        'rows': [row(r) for r in result.rows], 'measured': taken or None}


def answer(result: Design) -> str:
    present, least = result.present, result.least
    if result.verdict is DesignVerdict.ENOUGH:
        also = f' {_uf(least)} or more meets the target.' if least is not None else (
            f' So does any from {_uf(result.rows[0])} to {_uf(result.rows[-1])}.'
            if result.rows[-1].risk <= result.target else '')
        return (f'No more capacitance is needed: with the present {_uf(present)} the risk is '
                f'{probability(present.risk)}.{also}')
    if result.verdict is DesignVerdict.FOUND:
        assert least is not None
        return (f'{_uf(least)} is the minimum capacitance that brings the risk under '
                f'{result.target:g}.')
    if result.verdict is DesignVerdict.OUT_OF_RANGE:
        return (f'No capacitance between {_uf(result.rows[0])} and {_uf(result.rows[-1])} brings '
                f'the risk under {result.target:g}: with the largest it is still '
                f'{probability(result.rows[-1].risk)}. {_others(result)}')
    cure = (' Raise regulator_voltage or lower the limit.' if result.rail != 'bus' else
            '' if result.voltage < result.network.battery_voltage else
            ' The limit is at or above the open-circuit voltage: check cells and battery_voltage, '
            'or lower the limit.')
    return (f'No capacitor helps: the mean, {present.mean:.4g} V, is at or below '
            f'{result.voltage:g} V. {_others(result)}{cure}')


def _others(result: Design) -> str:
    # A lever that already meets the target at its present value cannot help.
    found = [f'{lever.name} of {lever.words(lever.least)} {lever.unit}' if lever.unit else
             f'{lever.words(lever.least)} {lever.name}' for lever in result.levers[1:]
             if math.isfinite(lever.least) and lever.least != lever.present]
    if found:
        return 'What would help: ' + ', or '.join(found) + '.'
    packs, charge = (f'{_PACKS} packs in parallel, nor ', 'land with more charge left, use more '
                     'cells, or ') if result.network.cells else ('', '')
    return (f'Neither {packs}{percent(_RESISTANCE)} of the resistance, nor {percent(_THROTTLE)} '
            f'of the throttle would be enough: {charge}allow a lower voltage.')


def _uf(row: DesignRow) -> str:
    return f'{number(1e6 * row.capacitance)} uF'


def probability(value: float) -> str:
    """Return a probability with two digits, or '<1e-12'."""
    return '<1e-12' if 0.0 < value < 1e-12 else number(value, 2)


# Minimum throttle for estimating the exponent of the sag.
_FROM = 0.1
# Bounds of the exponent of the current over throttle.
_EXPONENTS = 1.0, 4.0


@dataclass(frozen=True)
class Flight:
    """What a recording shows of its supply; NaN: unknown."""

    level: float  # Open-circuit voltage at the end of the recording, V
    full: float  # Highest median of half a second, V
    cells: int  # Cells in series; 0: unknown
    throttle: Sequence[float]  # 0..1, at which the next four fields are given
    sag: Sequence[float]  # V
    sag_se: Sequence[float]  # V
    noise: Sequence[float]  # Rms of the noise in flight, V
    steady: Sequence[float]  # Rms of the noise while throttle is constant, V
    flown: tuple[float, float]  # 1 % and 99 % quantile of throttle
    resistance: float  # Sag after a second over the measured current, Ohm
    alpha: float  # Relaxation rate of the OU, 1/s
    var_inf: float  # Variance of the OU, V^2

    def sag_at(self, throttle: float) -> tuple[float, float]:
        """Return the sag at a throttle and its standard error, V."""
        return (float(np.interp(throttle, self.throttle, self.sag)),
                float(np.interp(throttle, self.throttle, self.sag_se)))


# Components that, if given, replace the load of a flight, so the flight's risk does not apply.
SHOWN = frozenset(('current_max', 'current_exponent', 'switching_scale', 'flutter'))


def network_of(flight: Flight, throttle: float, given: dict[str, Any]) -> PowerNetwork:
    """Return the network of a flight, with values `given` in place of measured ones."""
    low, high = flight.flown
    u, sag = np.asarray(flight.throttle), np.asarray(flight.sag)
    at, _ = flight.sag_at(throttle)
    rms, steady = (float(np.interp(throttle, u, np.asarray(one)))
                   for one in (flight.noise, flight.steady))
    if not (math.isfinite(flight.level) and math.isfinite(at) and at > 0.0):
        raise ValueError('the recording does not show its sag: throttle and voltage must move')
    if not math.isfinite(rms):
        raise ValueError(f'the recording does not show the noise at throttle {throttle:g}')
    values: dict[str, Any] = {'battery_voltage': flight.level, **given}
    if flight.resistance > 0.0:
        # Current and noise are computed with the recorded resistance, not with a given one.
        values['battery_resistance'] = flight.resistance
    network = PowerNetwork(**completed(values))
    seen = (u >= max(_FROM, low)) & (u <= high) & (sag > 0.0)
    if 'current_exponent' not in given and seen.sum() > 1:
        slope = float(np.polyfit(np.log(u[seen]), np.log(sag[seen]), 1)[0])
        network = replace(network, current_exponent=float(np.clip(slope, *_EXPONENTS)))
    if 'current_max' not in given:
        network = replace(network, current_max=at / network.battery_resistance / max(
            throttle, 1e-3) ** network.current_exponent)
    slow = max(0.0, rms ** 2 - steady ** 2) if math.isfinite(steady) else 0.0
    rate = network.flutter_rate
    if flight.var_inf > slow:
        slow, rate = min(flight.var_inf, rms ** 2), flight.alpha
    if throttle == 1.0:
        # At full throttle no ESC switches, so all of the noise counts as slow.
        slow = rms ** 2
    quiet = replace(network, switching_scale=0.0, flutter=0.0, flutter_rate=rate)
    base = rail_at(quiet, throttle).var_inf
    scales: dict[str, Any] = {}
    for name, variance in (('switching_scale', rms ** 2 - slow - base), ('flutter', slow)):
        unit: dict[str, Any] = {name: 1.0}
        one = rail_at(replace(quiet, **unit), throttle).var_inf - base
        scales[name] = math.sqrt(max(0.0, variance) / one) if one > 0.0 else 0.0
    return replace(quiet, **{**scales, **{
        name: given[name] for name in (*scales, 'battery_resistance') if name in given}})
