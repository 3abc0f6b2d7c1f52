"""
Compare a recording with simulations of it under the recorded throttle.

Limits: the only input of the fitted model is throttle or current; the bands include errors of its
parameters, estimated from held-out parts, but not later changes of the craft.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math

import numpy as np
from ou_monitor.comparison.flight_model import (
    FiledModel, fit_flight, FlightModel, MOVES, Readings)
from ou_monitor.comparison.yardstick import (
    Agreement, band, differences, distance, judge, Measures, SpectrumBand, Traces, Yardstick)
from ou_monitor.criticism.adc import without_repeats
from ou_monitor.criticism.curves import stray
from ou_monitor.criticism.readings import current_at, on_time, usable, why_no_model
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray, Recording
from ou_monitor.text import counted, number, percent

# Minimum readings and duration, s, of a part; minimum number of simulations (at which 5 % of good
# models are rejected), and maximum.
_LEAST, _SHORTEST, _FEWEST_SEEDS, _MOST_SEEDS = 50, 0.2, 20, 10_000
# Maximum points of the band on a page.
_POINTS = 2000
# Probability above which the other kind of level (constant or falling) is reported.
_UNSURE = 0.05
# Minimum time at the beginning of the recording over which a model from a file is aligned, s.  It
# is doubled until the means over it differ between simulations by a standard deviation of at most
# `_STEADY` times that of single samples; it then holds about ten independent pieces.
_ALIGNED, _STEADY = 2.0, 0.3


def compare(recording: Recording, model: SupplyModel | None = None, *,
            fit_until: float | None = None, seeds: int = 50, seed: int = 0,
            levels: tuple[float, ...] = (),
            progress: Callable[[float], None] | None = None) -> Agreement:
    """Compare a recording with simulations: see `ou_monitor.compare` (levels: limits, V)."""
    report = progress or (lambda share: None)
    if not _FEWEST_SEEDS <= seeds <= _MOST_SEEDS:
        raise ValueError(f'seeds must lie within {_FEWEST_SEEDS} to {_MOST_SEEDS}, got {seeds}')
    notes = list(recording.notes)
    samples, offset = _samples(recording, notes)
    duration = float(samples.t[-1])
    begin = _start_index(samples, fit_until, fitted=model is None)
    if model is None:
        fitted = fit_flight(samples.part(slice(0, begin)), lambda share: report(0.6 * share))
        simulator: FlightModel | FiledModel = fitted
        notes += _fit_notes(fitted, samples)
    else:
        samples = _checked_load(model, samples, recording.name, notes)
        simulator = FiledModel(model)
        notes.append('The errors of the parameters in the model file are not simulated: the '
                     'bands include only the noise.')
    part = slice(begin, samples.t.size)
    # Codes of an ADC may have any offset.
    lsb, code = samples.lsb, float(np.sort(samples.voltage)[samples.t.size // 2])

    def read(v: FloatArray) -> FloatArray:
        return np.asarray(code + lsb * np.rint((v - code) / lsb)) if lsb > 0.0 else v

    own = samples.part(part)
    own = replace(own, voltage=read(own.voltage))
    yardstick = Yardstick(own, lsb, levels, code)
    rng = np.random.default_rng(seed)
    shifts = np.zeros(seeds)
    stride = max(1, -(-own.t.size // _POINTS))
    # A model from a file has the level of another flight.
    aligned, before = None, 0.6
    if model is not None:
        drawn, before = [], 0.3
        for k in range(_FEWEST_SEEDS):
            drawn.append(simulator.draw(samples, np.random.default_rng((seed, k)))[part][::stride])
            report(before * (k + 1) / _FEWEST_SEEDS)
        aligned = _beginning(own.t, np.array(drawn), stride)
    measured: list[Measures] = []
    traces = np.empty((seeds, own.voltage[::stride].size), dtype=np.float32)
    total, first = np.zeros(own.t.size), own.voltage
    strays = 0
    for k in range(seeds):
        v = simulator.draw(samples, rng)[part]
        if not np.isfinite(v).all():
            raise InputError('the model diverges over this throttle: its voltage is not finite')
        if aligned is not None:
            # Align each simulation by itself, so that the bands include the error of the level.
            shifts[k] = (own.voltage[aligned] - v[aligned]).mean()
            v = v + shifts[k]
        total += v
        v = read(v)
        first = v if k == 0 else first
        strays += stray(v, samples.voltage) > 0.0
        measured.append(yardstick.measure(v))
        traces[k] = v[::stride]
        report(before + (1.0 - before) * (k + 1.0) / seeds)
    if aligned is not None:
        notes.append(f'The level of the model was moved by {number(float(shifts.mean()), 3)} V '
                     f'(+- {number(float(shifts.std()), 2)} V), so that the mean of the first '
                     f'{number(float(np.ptp(own.t[aligned])))} s of each simulation equals the '
                     "recording's.")
    if strays:
        notes.append(f'{strays} of {seeds} simulations leave the range of the recording by more '
                     'than half of it.')
    path = fitted.path(samples)[part] if model is None else total / seeds
    real = yardstick.measure(own.voltage)
    spread = float(np.ptp(own.voltage))
    error = path - own.voltage
    thirds = tuple(float(part.mean()) for part in np.array_split(error, 3))
    found = differences(yardstick, real, measured, spread, thirds)
    explained = 1.0 - float(error @ error) / float(
        np.sum((own.voltage - own.voltage.mean()) ** 2))
    p, verdict, words, farthest = judge(found, explained, own.throttle is not None and bool(
        np.ptp(own.throttle) >= MOVES and np.ptp(path) > 0.0))
    pooled = np.mean([m.distribution for m in measured], axis=0)
    responses = np.array([m.response for m in measured])
    falls = [band(-one.measured, -one.simulated) for one in found if one.kind == 'answer']
    low, high = np.percentile(traces, [2.5, 97.5], axis=0)
    empty = np.empty(0)
    response_low, response_high = (empty, empty) if not responses.size else np.percentile(
        responses, [2.5, 97.5], axis=0)
    return Agreement(
        recording.name, (0.0, float(own.t[0]) if model is None else 0.0),
        (float(own.t[0]), duration), tuple(simulator.names),
        explained, math.sqrt(float(np.mean(error ** 2))), round(float(error.mean()), 12),
        thirds,  # type: ignore[arg-type]
        found[0].band, found[1].band, tuple(yardstick.levels),
        tuple(one.band for one in found if one.kind == 'dips'),
        tuple(SpectrumBand(float(a), float(b), band(
            math.sqrt(real.power[k]), np.sqrt([m.power[k] for m in measured])))
            for k, (a, b) in enumerate(zip(yardstick.bands, yardstick.bands[1:]))),
        None if yardstick.line is None else SpectrumBand(
            yardstick.line.frequency, yardstick.line.frequency, next(
                one.band for one in found if one.kind == 'line')),
        falls[0] if falls else None, falls[1] if falls else None, int(yardstick.rises.size),
        band(distance(real, pooled), np.array([distance(m, pooled) for m in measured])),
        seeds, p, verdict, words, farthest, tuple(notes),
        Traces(own.t + offset, own.voltage,
               np.full(own.t.size, np.nan) if own.throttle is None else own.throttle, first,
               own.t[::stride] + offset, low, high, yardstick.after if responses.size else empty,
               real.response, response_low, response_high, yardstick.edges,
               real.distribution, pooled))


def _beginning(t: FloatArray, drawn: FloatArray, stride: int) -> slice:
    """Return the samples over which simulations, V (every stride-th sample), are aligned."""
    moves = drawn - drawn.mean(axis=0)
    span = _ALIGNED
    while span < t[-1] - t[0]:
        end = max(10, int(np.searchsorted(t, t[0] + span, side='right')))
        if moves[:, :max(1, end // stride)].mean(axis=1).std() <= _STEADY * moves.std():
            return slice(0, end)
        span *= 2.0
    return slice(0, t.size)


def _samples(recording: Recording, notes: list[str]) -> tuple[Readings, float]:
    """Return the readings without repeats, with stamps from 0 s on, and the first stamp, s."""
    t, v, u = usable(recording, notes)
    if v.size < 2 * _LEAST:
        raise InputError(f"'{recording.name}' holds {counted(v.size, 'usable sample')}; a "
                         f'comparison needs at least {2 * _LEAST}')
    reason = why_no_model(v)
    if reason:
        raise InputError(f"'{recording.name}': {reason}")
    t, v, u, period = without_repeats(t, v, u)
    if period > 1.0:
        notes.append(f'The logger repeats its last value, {number(period, 3)} samples per '
                     'reading: each reading is simulated and counted once.')
    if u is not None:
        u = np.clip(u, 0.0, 1.0)
    return Readings(t - t[0], v, u, current_at(recording, t)), float(t[0])


def _start_index(samples: Readings, fit_until: float | None, fitted: bool) -> int:
    duration = float(samples.t[-1])
    until = (0.5 * duration if fitted else 0.0) if fit_until is None else fit_until
    if not 0.0 <= until < duration or (fitted and not until > 0.0):
        raise InputError(f'the fit must end within the recording, 0 to {number(duration, 4)} s, '
                         f'got {until:g} s')
    begin = int(np.searchsorted(samples.t, until))
    for what, n, seconds in (
            ('fitted', begin, until), ('simulated', samples.t.size - begin, duration - until)):
        if (what == 'simulated' or fitted) and (n < _LEAST or not seconds > _SHORTEST):
            raise InputError(
                f'the part to be {what} has {counted(n, "reading")} in {number(seconds, 3)} s; it '
                f'needs {_LEAST} in more than {_SHORTEST:g} s')
    return begin


def _fit_notes(model: FlightModel, samples: Readings) -> list[str]:
    if model.load is not None:
        found = []
        if model.load.model.full_current:
            found.append('The simulated load is current, which explains the voltage better than '
                         'throttle.' if samples.throttle is not None else
                         'The simulated load is current.')
        falls = math.isnan(model.load.model.constant_level)
        if model.doubt > _UNSURE:
            found.append('Whether the pack discharges is open: the level '
                         f'{"is constant" if falls else "falls"} in {percent(model.doubt)} of the '
                         'simulations.')
        elif not falls:
            found.append('No discharge is visible, so the level is constant.')
        return found
    if samples.current is None and samples.throttle is None:
        return ['Throttle is not recorded: only level and noise are simulated.']
    if samples.current is None and samples.throttle is not None and not np.ptp(
            samples.throttle) >= MOVES:
        return ['Throttle does not move: only level and noise are simulated.']
    return ['Neither throttle nor current explains the voltage: only level and noise are '
            'simulated.']


def _checked_load(model: SupplyModel, samples: Readings, name: str, notes: list[str]
                  ) -> Readings:
    """Return the readings with late current corrected; InputError if the load is missing."""
    needs = model.needs_throttle
    if model.full_current:
        if needs and samples.current is None:
            raise InputError(f"the load of the model is a current, and '{name}' has none")
        return samples if samples.current is None else replace(samples, current=on_time(
            samples.t, samples.voltage, samples.current, 'current', notes)[0])
    if needs and samples.throttle is None:
        raise InputError(f"the model's term '{needs[0]}' needs throttle, and the recording has "
                         'none')
    return samples
