"""
Everything that the node computes, without ROS: estimate, risk, and the health of the input.

The node pushes samples and requests reports.  The offline tools do the same with a recording, so
both give the same results for the same data.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ou_monitor.online.estimator.estimator import (
    of_estimate, RelaxationFits, SLIDING, SlidingEstimator, untimed)
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.model_watch import ModelComparison
from ou_monitor.online.load.supply_load import SupplyLoad
from ou_monitor.online.risk.flag import BrownoutFlag, FlagLevel, FlagState
from ou_monitor.online.risk.forecast import (
    Forecast, LOOK, look_ahead, risk_over_throttle, RiskOutlook)
from ou_monitor.online.settings import AUTO, DEFAULT_LIMIT, MonitorSettings, RAIL
from ou_monitor.online.trust import Doubt, InputTrust, patience, StampOrder
from ou_monitor.records import (
    as_numbers, as_seconds, Counters, Estimate, Flag, FloatArray, Level, MOST_STAMP, NAN, OuFacts,
    Status)
from ou_monitor.timeline import (
    as_column, as_columns, Batch, MOST_CURRENT, MOST_THROTTLE, MOST_VOLTAGE, OFF, plausible,
    TimeLine, WILD_FACTOR)

if TYPE_CHECKING:
    from ou_monitor.model.supply import SupplyModel

# Cautions that make the numbers doubtful; the other cautions are only information.
_DOUBTFUL = frozenset({Flag.SLOW_RATE, Flag.QUANTIZED, Flag.LOWPASS_UPSTREAM, Flag.SATURATED,
                       Flag.TREND, Flag.IRREGULAR})
# Minimum voltage of a supply that is on, V: a cell has at least 2.5 V; without a supply, noise is
# at most 0.5 V.
_POWERED = 2.0
# Time after which a much lower or much higher voltage counts as another supply, s.
_ANOTHER = 60.0


class SupplyMonitor:
    """
    Estimator, risk and health of the input behind one node.

    Parameters
    ----------
    settings : MonitorSettings, optional
        Settings; by default, the default parameters.
    model : SupplyModel, optional
        Terms of the supply, as `discover` found them; by default, none.
    background : bool
        Whether the fits of alpha, sigma and Var_inf for window ``auto`` run in a thread, so that
        reports never wait.
    look : float
        Interval at which forecasts of the risk are compared with their outcomes, s.
    replay : bool
        Whether only risks within the horizon of the settings are needed, and no flag.

    Examples
    --------
    >>> from ou_monitor import MonitorSettings, read_recording, SupplyMonitor
    >>> recording = read_recording('bags/flight', end=12.0)
    >>> monitor = SupplyMonitor(MonitorSettings(brownout_voltage=4.5))
    >>> monitor.push(recording.t, recording.voltage, recording.throttle)
    >>> report = monitor.report(age=0.0)
    >>> 0.0 <= report.risk <= 1.0
    True

    """

    def __init__(self, settings: MonitorSettings | None = None,
                 model: SupplyModel | None = None, *, background: bool = False,
                 look: float = LOOK, replay: bool = False) -> None:
        self._settings = settings or MonitorSettings()
        self._background, self._look, self._replay = background, look, replay
        if model is not None and not hasattr(model, 'load'):
            raise TypeError(f'model: a SupplyModel is needed, got a {type(model).__name__}; for a '
                            'model file, pass read_model(path).model')
        self._model = model
        self._flag = BrownoutFlag(self._settings)
        self._trust = InputTrust()
        # Quality of the stamps, and doubt about the input, in the last report.
        self._stamps, self._doubt = StampOrder.GOOD, Doubt.NONE
        self._reset_reason = ''
        self._restarts, self._fault, self._faulty = 0, '', False
        # For thinning: samples left out so far, and samples pushed modulo `thin`.
        self._thinned = self._phase = 0
        # Sum of the counts of earlier estimators, before restarts.
        self._counted = Counters()
        # Number of late and unusable samples so far, and stamp of its last increase.
        self._odd, self._odd_at = 0, -math.inf
        self._begin()

    def _begin(self, line: TimeLine | None = None) -> None:
        # Voltage of the supply, V (decays slowly while off); stamp at which it was last on, s.
        self._level, self._on_at = NAN, NAN
        self._line = line or TimeLine()
        self._estimator = SlidingEstimator(self._sliding, line=self._line)
        self._relaxation = RelaxationFits(background=self._background)
        self._load_filter, self._load = LoadFilter(), SupplyLoad()
        self._load_filter.begin_with(None if self._model is None else self._model.load)
        self._newest = Estimate()
        self._forecast = Forecast(
            self._load_filter, self._look,
            self._settings.brownout_horizon if self._replay else NAN)
        # Risk and budget of the last report.
        self._ahead = RiskOutlook()

    @property
    def settings(self) -> MonitorSettings:
        """Return the present settings."""
        return self._settings

    @property
    def _sliding(self) -> float:
        """Length of the sliding window, s."""
        window = self._settings.window
        return SLIDING if isinstance(window, str) else window

    def configure(self, settings: MonitorSettings) -> None:
        """Change settings; no sample inside the new window is lost."""
        self._settings = settings
        if self._sliding != self._estimator.window:
            self._estimator.window = self._sliding
        self._flag.configure(settings)

    @property
    def load_filter(self) -> LoadFilter:
        """Return the load filter; errors of the estimator reset it, parameters never do."""
        return self._load_filter

    @property
    def model(self) -> SupplyModel | None:
        """Return the present terms of the supply."""
        return self._model

    def set_model(self, model: SupplyModel | None) -> None:
        """Change the terms of the supply; window and flag are kept."""
        self._model = model
        self._load_filter.begin_with(None if model is None else model.load)

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None, arrival: npt.ArrayLike | None = None,
             *, current: npt.ArrayLike | None = None, thin: int = 1) -> None:
        """
        Add samples; see `SlidingEstimator.push`.

        Voltages beyond 1e6 V and throttles beyond 2 are implausible and become NaN.

        Parameters
        ----------
        t, voltage, throttle : array_like, shape (n,), or float
            Stamps, s; voltage, V; throttle, 0..1 (one number for all samples; None: unknown).
        arrival : array_like, shape (n,), optional
            Arrival of each sample, s, by the clock of `report`'s argument `now`.  The check
            against the voltage floor uses it for samples whose stamps are late.
        current : array_like, shape (n,), or float, optional
            Current drawn from the supply, A, positive; NaN where unknown.
        thin : int
            Only every `thin`-th sample goes to the estimator; all are checked against the floor.

        Raises
        ------
        ValueError
            When the shapes differ.

        """
        stamps = plausible(np.atleast_1d(as_seconds(t)), MOST_STAMP)
        volts = plausible(as_column(voltage), MOST_VOLTAGE)
        load = None if throttle is None else plausible(
            np.broadcast_to(as_numbers(throttle), volts.shape), MOST_THROTTLE)
        times = None if arrival is None else np.atleast_1d(as_seconds(arrival))
        part = slice(-self._phase % thin, None, thin)
        self._phase = (self._phase + stamps.size) % thin
        self._thinned += stamps.size - stamps[part].size
        drawn = None if current is None else plausible(np.broadcast_to(
            as_numbers(current), stamps.shape)[part], MOST_CURRENT)
        came = math.inf if times is None or not times.size else float(times[-1])
        columns = as_columns(
            stamps[part], volts[part], None if load is None else load[part], drawn)
        try:
            for batch in self._line.take(columns, self._sliding):
                self._take(batch, came)
        except Exception as error:
            # Catch every error, because after an exception here nothing would be reported.
            self.restart(error)
        self._trust.push(stamps, volts, load, times)
        self._flag.push(stamps, volts, times, self._trust.interval)

    def _take(self, batch: Batch, came: float) -> None:
        """Pass on readings while the supply is on; start again when it is switched on."""
        t, level = float(batch.t[-1]), self._level
        if math.isnan(level) and batch.t.size > 3 and not batch.again:
            # The first readings show whether the supply is on.
            self._take(Batch(batch.columns[:, :3], batch.restart), came)
            self._take(Batch(batch.columns[:, 3:], False), came)
            return
        before = level
        if level >= _POWERED:
            on = (batch.y >= OFF * level) & (batch.y <= WILD_FACTOR * level)
            if not on.any() and (batch.restart or t - self._on_at > _ANOTHER):
                self._begin(self._line)
            elif not on.all():
                self._forecast.see(batch.y[~on])
                if not on.any():
                    return
                batch = Batch(batch.columns[:, on], batch.restart, batch.again)
            level *= math.exp(-max(t - self._on_at, 0.0) / _ANOTHER)
        self._pass_on(batch, came)
        now = self._forecast.voltage
        on = batch.y >= OFF * now
        if now >= _POWERED and before < OFF * now and on.any():
            self._begin(self._line)
            self._pass_on(Batch(batch.columns[:, on], True), came)
        self._level, self._on_at = level if level > now else now, t

    def _pass_on(self, batch: Batch, came: float) -> None:
        self._estimator.take(batch)
        self._relaxation.take(batch)
        if not batch.again:
            self._forecast.take(batch, came)

    def watch(self, voltage: npt.ArrayLike, arrival: npt.ArrayLike) -> None:
        """
        Check samples without a stamp against the voltage floor only.

        Voltage in V and arrival in s, shape (n,), as in `push`.
        """
        volts = plausible(np.atleast_1d(np.asarray(voltage, dtype=np.float64)), MOST_VOLTAGE)
        times = np.atleast_1d(np.asarray(arrival, dtype=np.float64))
        self._trust.push_readings(times, volts)
        self._flag.push(np.full_like(volts, NAN), volts, times, self._trust.interval)

    def restart(self, error: BaseException) -> None:
        """Restart after an error, and name it in the next reports; the flag keeps its state."""
        words = ' '.join(str(error).split())[:200]
        self._fault = f'{type(error).__name__}: {words}' if words else type(error).__name__
        self._faulty = True
        self._restarts += 1
        self._counted = self._counters()
        self._begin()

    def _counters(self) -> Counters:
        now = self._estimator.counters
        return Counters(**{f.name: getattr(now, f.name) + getattr(self._counted, f.name)
                           for f in fields(Counters)})

    def distrust(self, reason: str) -> None:
        """
        Distrust the input for this reason, until called with an empty reason.

        The check against the voltage floor continues.
        """
        self._trust.outside = reason

    def clear_brownout(self) -> str:
        """
        Clear a CRITICAL flag that is latched or held; the next report judges again.

        Returns
        -------
        str
            What was cleared; empty if there was nothing to clear.

        """
        old = self._flag.state
        return (f'CRITICAL of {old.age:.1f} s is cleared; the next report decides again.'
                if self._flag.clear() else '')

    def set_brownout(self, reason: str) -> None:
        """Restore a CRITICAL flag after a restart; latch, hold and clearing apply as usual."""
        self._flag.set_critical(reason)

    def doubt_brownout(self, reason: str) -> None:
        """Report the flag as UNKNOWN for this reason, unless it is CRITICAL."""
        self._flag.doubt(reason)

    def reset(self, reason: str) -> None:
        """Clear the window; the next reports state the reason, and the flag keeps its state."""
        self._estimator.reset()
        self._relaxation.forget()
        self._flag.new_time_line()
        self._trust.start_anew()
        self._load_filter.new_time_line()
        self._forecast.new_time_line()
        self._reset_reason = reason

    def report(self, age: float | None, now: float | None = None,
               arrived: float | None = None, *, again: bool = True,
               alone: bool = False) -> MonitorReport:
        """
        Return the present results.

        Parameters
        ----------
        age : float or None
            Age of the newest voltage, s; None before the first one.
        now : float, optional
            Present time, s, by which the flag counts hold and delay; by default the stamp of the
            newest sample plus `age`.
        arrived : float, optional
            Time since the last voltage arrived, s, regardless of its stamp; by default `age`.
            A voltage at the floor counts as long as voltages arrive.
        again : bool
            Whether to estimate again; if false, the numbers of the last report are kept, and only
            floor, flag and ages are updated.
        alone : bool
            Whether only the risk is needed, not the budget.

        Returns
        -------
        MonitorReport
            The report.

        """
        silent = math.inf if age is None else max(age, 0.0)
        here = silent if arrived is None else max(arrived, 0.0)
        try:
            e = self._estimate() if again else self._newest
            if again and self._settings.window == AUTO:
                self._relaxation.update()
            limit = patience(self._settings, e.rate, e.n, self._trust.interval)
            stamps = self._trust.stamps(limit, 1.0 / e.rate if e.rate > 0.0 else NAN)
            doubt, why = self._trust.doubt(stamps, self._settings.brownout_voltage)
            if self._doubt is Doubt.UNIT is not doubt:
                # The unit of the input has changed: discard results in the previous unit.
                self._counted = self._counters()
                self._begin()
                e = self._estimate()
            shown, ou, ou_age = self._relaxation.in_force(e) if (
                self._settings.window == AUTO) else (e, of_estimate(e), 0.0)
            if doubt in (Doubt.STAMPS, Doubt.OTHER):
                shown = untimed(shown)
                ou = of_estimate(shown)
            self._stamps, self._doubt = stamps, doubt
            fresh = (silent <= limit and e.status is not Status.NO_DATA and doubt is Doubt.NONE)
            if again or not fresh:
                self._load = self._load_filter.load()
                # Use sigma of a longer window, which is more accurate, only if the short window
                # shows an OU too; otherwise the load model is more accurate.
                self._forecast.follow(*((shown, ou.window_s, ou_age) if e.usable and shown.usable
                                        else (e, e.duration)))
                self._ahead = look_ahead(
                    self._forecast, self._load, self._settings, alone=alone) if (
                        fresh) else RiskOutlook(budget_reason=why)
        except Exception as error:
            # Catch every error, as in `push`.
            self.restart(error)
            e = Estimate(counters=self._counters())
            limit, stamps, fresh = self._settings.stale_after, StampOrder.GOOD, False
            doubt, why = Doubt.NONE, ''
            self._ahead = RiskOutlook()
            shown, ou, ou_age = e, of_estimate(e), 0.0
        # Keep the sliding estimate; report the one that is shown.
        self._newest, e = e, shown
        ahead = self._ahead
        risk = ahead.outcome.risk
        self._faulty = self._faulty and not e.usable
        arriving = here <= max(self._settings.stale_after, limit)
        flag = self._flag.update(e.t + silent if now is None else now, risk, ahead.soon,
                                 ahead.tight, fresh=fresh, arriving=arriving)
        silence = '' if fresh else why if arriving and why else self._silence_words(
            age, e, limit, late=silent - here > limit)
        wrong = doubt if silence and silence == why else Doubt.NONE
        level, summary = self._judge(e, risk, flag, silence, wrong)
        left_out = () if self._model is None else self._model.left_out
        model = None if self._model is None else self._load_filter.against(
            self._model.load, self._model.date)
        cautions = [words for words in (
            self._default_limit_words(), model.words if model else '') if words]
        if cautions and fresh and level < Level.ERROR:
            level, summary = Level.WARN, ' '.join((summary, *cautions))
        return MonitorReport(
            e, risk, ahead.budget, ahead.budget_reason, left_out, flag, level, summary, silent,
            limit, stamps, doubt, fresh, self._thinned, self._restarts, self._fault, self._load,
            ahead.outcome.basis, ahead.outcome.cause, ahead.curve, ou, ou_age, model)

    def risk(self, voltage: float | None = None, horizon: float | None = None) -> float:
        """
        Return P(below `voltage` within `horizon`) from the newest sample on.

        Parameters
        ----------
        voltage : float, optional
            V; by default `brownout_voltage`.
        horizon : float, optional
            Time ahead, s; by default `brownout_horizon`.

        Returns
        -------
        float
            Probability, including the pilot's future throttle; NaN without voltage, in the first
            second, or if the input is not trusted.

        Raises
        ------
        ValueError
            When the voltage is not finite, or the horizon not positive.

        """
        wanted = self._checked(voltage, horizon)
        if not self._trusted:
            return NAN
        return self._forecast.risk(*wanted).risk

    def risk_if(self, throttle: float, dwell: float, voltage: float | None = None,
                horizon: float | None = None) -> float:
        """
        Return the risk (see `risk`) if throttle goes to `throttle`, stays, and returns.

        Parameters
        ----------
        throttle : float
            Throttle to go to, 0..1.
        dwell : float
            Time there, s.
        voltage, horizon : float, optional
            As for `risk`.

        Returns
        -------
        float
            Probability; NaN if the load is unknown or the input is not trusted.

        Raises
        ------
        ValueError
            When the throttle lies outside 0..1, the dwell is negative, or as in `risk`.

        """
        level, ahead = self._checked(voltage, horizon)
        if not (math.isfinite(throttle) and 0.0 <= throttle <= 1.0):
            raise ValueError(f'throttle must lie within 0..1, got {throttle}')
        if not (math.isfinite(dwell) and dwell >= 0.0):
            raise ValueError(f'dwell must be a number of seconds, not negative, got {dwell}')
        if not self._trusted:
            return NAN
        return float(self._forecast.risk_if(throttle, dwell, level, ahead)[0])

    def changed_risk(self, sag: float, noise: float, voltage: float) -> FloatArray:
        """Return the risks over throttle, (51,), if sag and noise variance change by factors."""
        level, ahead = self._checked(voltage, None)
        return risk_over_throttle(self._forecast, level, ahead, sag, noise)

    @property
    def _trusted(self) -> bool:
        """Whether the readings are trusted, regardless of the limit."""
        return self._trust.doubt(self._stamps, math.inf)[0] is Doubt.NONE

    def _checked(self, voltage: float | None, horizon: float | None) -> tuple[float, float]:
        level = self._settings.brownout_voltage if voltage is None else voltage
        ahead = self._settings.brownout_horizon if horizon is None else horizon
        if not math.isfinite(level):
            raise ValueError(f'voltage must be finite, got {level} V')
        if not (math.isfinite(ahead) and ahead > 0.0):
            raise ValueError(f'horizon must be a positive number of seconds, got {ahead}')
        return level, ahead

    def _estimate(self) -> Estimate:
        """Return the newest estimate; its flag IRREGULAR refers to the present window only."""
        e = self._estimator.estimate()
        counters = self._counters()
        odd = counters.late + counters.non_finite
        if odd > self._odd:
            self._odd, self._odd_at = odd, e.t
        flags = e.flags
        if e.t - self._odd_at > self._sliding:
            flags = tuple(flag for flag in flags if flag is not Flag.IRREGULAR)
        if flags == e.flags and counters == e.counters:
            return e
        return replace(e, flags=flags, counters=counters)

    def _silence_words(self, age: float | None, e: Estimate, limit: float, late: bool) -> str:
        if age is not None and age > limit:
            why = f'stale_after = {self._settings.stale_after:g} s'
            if limit != self._settings.stale_after:
                why = f'a source of {float(f"{e.rate:.3g}"):g} Hz is stale after {limit:.2g} s'
            if late:
                return (f'Voltages arrive late: the newest is {age:.1f} s old by its stamp '
                        f'({why}); the publisher, the link or this machine cannot keep up.')
            return f'No voltage for {age:.1f} s ({why}): check the publisher.'
        if e.counters.non_finite and not e.counters.used:
            return (f'No usable voltage: all {e.counters.non_finite} samples were NaN or '
                    'infinite; check the sensor.')
        if self._reset_reason:
            return f'The window was cleared ({self._reset_reason}) and is filling again.'
        return Status.NO_DATA.value

    def _judge(self, e: Estimate, risk: float, flag: FlagState, silence: str, doubt: Doubt
               ) -> tuple[Level, str]:
        """Return the level of the diagnostics and the line for the pilot."""
        critical = flag.level is FlagLevel.CRITICAL
        if self._faulty:
            still = f' The brown-out flag is set: {flag.reason}.' if critical else ''
            return Level.ERROR, (
                f'The estimator failed ({self._fault}) and was restarted ({self._restarts} times '
                f'so far); it has no estimate yet.{still}')
        if silence and critical and flag.low:
            return Level.ERROR, f'{self._risk_words(e, risk, flag)} {silence}'
        if silence:
            still = f' The brown-out flag is still set: {flag.reason}.' if critical else ''
            wrong = doubt in (Doubt.UNIT, Doubt.LIMIT)
            return (Level.ERROR if wrong else Level.STALE), silence + still
        if critical:
            return Level.ERROR, self._risk_words(e, risk, flag)
        if flag.level is FlagLevel.WARN and flag.brownout is not None:
            return Level.WARN, self._risk_words(e, risk, flag)
        if not e.usable:
            rate = f' Input: {e.n} samples at {e.rate:.3g} Hz.' if e.rate > 0.0 else ''
            if without_alpha := self._load.words(e):
                good = self._load.known and math.isfinite(risk) and flag.level is FlagLevel.OK
                return Level.OK if good else Level.WARN, without_alpha
            return Level.WARN, e.status.value + rate
        if flag.level is not FlagLevel.OK:
            return Level.WARN, self._risk_words(e, risk, flag)
        doubts = [caution.value for caution in e.flags if caution in _DOUBTFUL]
        if doubts:
            return Level.WARN, ' '.join(doubts)
        return Level.OK, e.status.value

    def _default_limit_words(self) -> str:
        """Return a caution if the default limit is used on a supply above 5 V rails."""
        limit, now = self._settings.brownout_voltage, self._forecast.voltage
        return (f'The limit is the default of {limit:g} V, for a 5 V rail, and the supply is at '
                f'{now:.3g} V: set brownout.voltage.') if (
                    limit == DEFAULT_LIMIT and now > RAIL[1]) else ''

    def _risk_words(self, e: Estimate, risk: float, flag: FlagState) -> str:
        s = self._settings
        load = f'; throttle {e.throttle:.2f}' if math.isfinite(e.throttle) else ''
        known = 'unknown' if math.isnan(risk) else f'{risk:.2g}'
        outcome = self._ahead.outcome
        if outcome.basis != 'none':
            words = outcome.basis.replace('_', ' ')
            known += f' (from {words}; main cause: {outcome.cause})' if outcome.cause else \
                f' (from {words})'
        now = self._forecast.voltage
        supply = f'; supply {now:.3f} V' if math.isfinite(now) else ''
        return (f'Risk of falling below {s.brownout_voltage:g} V within {s.brownout_horizon:g} s: '
                f'{known}, critical from {s.brownout_critical:g} within 1 s{load}{supply}; '
                f'{flag.level.name} for {flag.age:.1f} s: {flag.reason}.')


# Throttles of `risk_curve`.
RISK_CURVE = tuple(k / 10.0 for k in range(11))


@dataclass(frozen=True)
class MonitorReport:
    """Result of the monitor at one instant."""

    estimate: Estimate  # Newest estimate, with alpha, sigma and var_inf of `ou`
    risk: float  # Probability of a brown-out within the horizon; NaN if unknown
    # Highest throttle, 0..1, with a risk below `brownout.budget_limit`; NaN if unknown.
    budget: float
    budget_reason: str  # Cause that limits the budget, or why it is unknown
    # Terms of the model file that the risk does not include.
    left_out: tuple[str, ...]
    flag: FlagState  # The brown-out flag, with its reason
    level: Level  # Level for the diagnostics
    summary: str  # One line for the pilot
    age: float  # Age of the newest voltage, s; inf before the first
    # Age from which the input is stale, s: `stale_after`, less for a fast source, more for a slow
    # one.
    patience: float
    stamps: StampOrder  # Quality of the stamps
    doubt: Doubt  # Why the input is not trusted
    fresh: bool  # Whether the numbers come from samples that are trusted and not too old
    # Samples that were only checked against the floor, because of overload.
    thinned: int
    restarts: int  # Restarts of the estimator after an error
    fault: str  # The last such error, in one line; empty when there was none
    # Level, sag and noise under load, which do not need a visible OU.
    load: SupplyLoad = SupplyLoad()
    # Method of the risk: ``first_passage``, ``load``, ``excursions`` or ``none``.
    risk_basis: str = 'none'
    # Main cause of the risk: noise, load now, or throttle to come; empty: unknown.
    risk_cause: str = ''
    # Risk if throttle goes to each value of `RISK_CURVE` and stays for the horizon; empty or NaN:
    # unknown.
    risk_curve: tuple[float, ...] = ()
    ou: OuFacts = OuFacts('no_data')  # Relaxation or its bounds, and their window
    ou_age: float = 0.0  # Time from the end of that window to the newest sample, s
    model: ModelComparison | None = None  # This flight compared with the model; None without one

    @property
    def brownout(self) -> bool | None:
        """Return the flag; None if it is unknown."""
        return self.flag.brownout

    @property
    def fields(self) -> dict[str, str]:
        """
        Return every field as text, for diagnostics; numbers round-trip.

        SI units; intervals are two numbers separated by a blank; `alpha_se`, `sigma_se` and
        `var_inf_se` are errors of the logarithm, `u0_se` is in V.
        """
        e = self.estimate
        values: dict[str, object] = {
            name: getattr(e, name) for name in (
                't', 'alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'var_inf_se', 'tau',
                'u0', 'u0_se', 'noise_std', 'voltage', 'throttle', 'n', 'duration', 'rate')}
        for field in fields(self.ou):
            found = getattr(self.ou, field.name)
            if isinstance(found, tuple):
                values[field.name] = ' '.join(repr(float(end)) for end in found)
            elif field.name not in values:
                values['ou_status' if field.name == 'status' else field.name] = found
        values['ou_age'] = self.ou_age
        values |= self.load.fields(e.throttle)
        values['brownout_risk'] = self.risk
        values['risk_basis'] = self.risk_basis
        values['risk_cause'] = self.risk_cause
        values['risk_curve'] = ' '.join(
            f'{u:.1f}:{p:.3g}' for u, p in zip(RISK_CURVE, self.risk_curve))
        values['brownout'] = 'unknown' if self.brownout is None else str(self.brownout).lower()
        values['brownout_level'] = self.flag.level.name
        values['brownout_level_age'] = self.flag.age
        values['brownout_reason'] = self.flag.reason
        values['floor_dips'] = self.flag.dips
        values['throttle_budget'] = self.budget
        values['model_left_out'] = ','.join(self.left_out)
        values['throttle_budget_reason'] = self.budget_reason
        values |= {} if self.model is None else self.model.fields()
        values['age'] = self.age
        values['patience'] = self.patience
        values['stamps'] = self.stamps.name
        values['doubt'] = self.doubt.value
        values['samples_thinned'] = self.thinned
        values['restarts'] = self.restarts
        values['fault'] = self.fault
        values['status'] = e.status.name
        values['status_text'] = e.status.value
        values['flags'] = ','.join(flag.name for flag in e.flags)
        for name in ('pushed', 'used', 'non_finite', 'late', 'held', 'resets'):
            values[name] = getattr(e.counters, name)
        # `float`, because the repr of NumPy's floats contains the name of their type.
        return {name: repr(float(v)) if isinstance(v, float) else str(v)
                for name, v in values.items()}
