"""Section 4.4: the share of time beyond a threshold, and the rate of reaching it."""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.model.passage.law import mean_first_passage
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.published import Printed, Row
from ou_monitor.paper.reproduce.table1 import over, vrms_range
from ou_monitor.paper.reproduce.table2 import sigma_of
from scipy.integrate import quad
from scipy.special import erfc

WHERE = 'Section 4.4'
# Threshold of the numbers, V: the paper gives none.
DELTA = 0.1
# Distance of independent samples, in tau: their correlation is exp(-SPACING).
_SPACING = 8.0


def beyond(delta: float, var_inf: float) -> float:
    """Return P(|U| > delta) in closed form, erfc(delta / sqrt(2 Var_inf))."""
    return float(erfc(delta / math.sqrt(2.0 * var_inf)))


def beyond_by_quadrature(delta: float, var_inf: float) -> float:
    """Return the integral of section 4.4 as printed, by quadrature."""
    scale = 1.0 / math.sqrt(2.0 * math.pi * var_inf)
    # Beyond 40 standard deviations the density is below the smallest double.
    end = delta + 40.0 * math.sqrt(var_inf)
    total, _ = quad(lambda x: scale * math.exp(-0.5 * x * x / var_inf), delta, end,
                    epsabs=0.0, epsrel=1e-12, limit=200)
    return 2.0 * float(total)


def count_beyond(
    state: published.PrintedLoad, deltas: tuple[float, ...], rng: np.random.Generator, draws: int,
) -> tuple[list[float], list[float]]:
    """
    Return the share of samples of a simulated OU beyond thresholds, and its standard error.

    deltas in V.
    """
    alpha = published.ALPHA.value
    u = np.abs(simulate(np.arange(draws) * (_SPACING / alpha), alpha, sigma_of(state), rng))
    share = [float(np.mean(u > delta)) for delta in deltas]
    return share, [math.sqrt(p * (1.0 - p) / draws) for p in share]


def rows(rng: np.random.Generator, draws: int = 1_000_000) -> list[Row]:
    """Return the rows of section 4.4."""
    found = []
    for state, deltas in ((published.MEDIUM, (0.05, DELTA)),
                          (published.HIGH, (0.05, DELTA, 0.15))):
        var = (1e-3 * state.vrms.value) ** 2
        for delta, share, error in zip(deltas, *count_beyond(state, deltas, rng, draws)):
            formula = beyond_by_quadrature(delta, var)
            closed = beyond(delta, var)
            found.append(Row(
                WHERE, f'P(|U| > {1e3 * delta:g} mV), {state.label}', '',
                Printed(f'{formula:.4g}'), share,
                f'printed integral by quadrature, against {draws} independent samples of the OU',
                f'The formula is right, and is erfc(delta / sqrt(2 Var_inf)) = {closed:.4g}.',
                error=error))
    return [*found, *_claims()]


def _claims() -> list[Row]:
    var = {s.label: (1e-3 * s.vrms.value) ** 2 for s in published.LOADED}
    high, medium, low = (var[s.label] for s in (published.HIGH, published.MEDIUM, published.LOW))
    ratio = beyond(DELTA, high) / beyond(DELTA, medium)
    spread = [beyond(DELTA, (1e-3 * v) ** 2) for s in (published.MEDIUM, published.HIGH)
              for v in vrms_range(s)]
    load = published.HIGH.load / published.MEDIUM.load
    times = [mean_first_passage(0.0, DELTA / math.sqrt(v)) / published.ALPHA.value
             for v in (medium, high)]
    wide = over(vrms_range(published.HIGH), vrms_range(published.LOW))
    return [
        Row(WHERE, f'P(|U| > {1e3 * DELTA:g} mV), 40 % over 10 %', '', Printed(f'> {load:g}'),
            ratio, 'quotient of the formula',
            f'"Nonlinear" holds: four times the load, {ratio:.0f} times the probability; half a '
            f'step of each Vrms allows {spread[2] / spread[1]:.0f} to '
            f'{spread[3] / spread[0]:.0f}.',
            inputs=(spread[2] / spread[1], spread[3] / spread[0])),
        Row(WHERE, f'falls by {1e3 * DELTA:g} mV a second, 40 over 10 %', '',
            Printed('> 1'), times[0] / times[1], 'quotient of mean first-passage times',
            'P(|U| > delta) is a share of time, not a frequency; by first passage the mean time '
            f'to such a fall is {times[0]:.3g} s at 10 % and {times[1]:.3g} s at 40 %.'),
        Row(WHERE, 'Var_inf, 40 % over 5 %', '', Printed('> 1'), high / low,
            'squared quotient of the Vrms',
            f'Larger, as printed: {high / low:.0f} times, {wide[0] ** 2:.0f} to '
            f'{wide[1] ** 2:.0f} within half a step.', inputs=(wide[0] ** 2, wide[1] ** 2))]
