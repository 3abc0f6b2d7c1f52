"""Section 5, "diffusion and jump components": the jumps that would explain the screens."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.shocks import Jumps
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.crest import crest, crest_of, Crests, TAIL, TYPICAL_MS
from ou_monitor.paper.reproduce.row import Printed, Range, Row

WHERE = 'Section 5'
# Jumps per second, and their share of the variance, that are tried.
RATES = (2.0, 5.0, 10.0, 20.0, 50.0)
SHARES = (0.25, 0.5, 0.75, 0.95)
SCREENS_MS = (100, 500)
# Sampled more coarsely than 1 MHz: takes less than 0.1 off a crest factor.
_SAMPLING = 20e3


@dataclass(frozen=True)
class JumpCrest:
    """Crest factors of an OU with jumps that relax at its alpha."""

    screen: int  # Length, ms
    rate: float  # Jumps per second
    share: float  # Their share of the variance
    # Mean Vpp/Vrms and its standard error.
    mean: float
    error: float
    band: Range  # 5 % and 95 % of the screens
    kurtosis: float  # Excess kurtosis of the stationary law

    def size(self, vrms: float) -> float:
        """Return the standard deviation of the jumps, in the unit of `vrms`."""
        return vrms * math.sqrt(2.0 * published.ALPHA.value * self.share / self.rate)


def excess_kurtosis(rate: float, share: float) -> float:
    """
    Return the excess kurtosis of an OU with normal jumps of mean zero.

    The fourth cumulant of the jumps is rate E J^4 / (4 alpha), and E J^4 is
    3 (E J^2)^2, with E J^2 = 2 alpha share Var_inf / rate.
    """
    return 3.0 * published.ALPHA.value * share * share / rate


def simulate_jumps(rng: np.random.Generator, seconds: float,
                   progress: Callable[[float], None] = lambda share: None) -> list[JumpCrest]:
    """Draw screens of OUs with jumps (seconds in s, progress 0..1)."""
    alpha = published.ALPHA.value
    longest = max(SCREENS_MS)
    # One extra screen, dropped later, in which the jumps reach their stationary law.
    t = np.arange(round((seconds + 1e-3 * longest) * _SAMPLING)) / _SAMPLING
    begin = round(1e-3 * longest * _SAMPLING)
    found = []
    for k, rate in enumerate(RATES):
        plain = simulate(t, alpha, math.sqrt(2.0 * alpha), rng)[begin:]
        jumping = SupplyModel((
            OU(alpha, 0.0, 0.0), Jumps(rate, 0.0, math.sqrt(2.0 * alpha / rate)))
        ).simulate(t, rng)[begin:]
        for share in SHARES:
            path = math.sqrt(1.0 - share) * plain + math.sqrt(share) * jumping
            for ms in SCREENS_MS:
                values = crest_of(path.reshape(-1, round(1e-3 * ms * _SAMPLING)))
                low, high = np.quantile(values, [TAIL, 1.0 - TAIL])
                # Neighbouring screens share little, a screen being many tau.
                found.append(JumpCrest(
                    ms, rate, share, float(values.mean()),
                    float(values.std(ddof=1) / math.sqrt(values.size)),
                    (float(low), float(high)), excess_kurtosis(rate, share)))
        progress((k + 1) / len(RATES))
    return found


def largest(found: list[JumpCrest], screen: int) -> JumpCrest:
    """Return the jumps with the largest mean crest factor on screens of that many ms."""
    return max((c for c in found if c.screen == screen), key=lambda c: c.mean)


def impulse_height(state: published.PrintedLoad, crests: Crests) -> float:
    """Return by how much short impulses must widen an OU to its printed Vpp, mV."""
    return state.vpp.value - crests.mean(TYPICAL_MS)[0] * state.vrms.value


def rows(found: list[JumpCrest], crests: Crests) -> list[Row]:
    """Return the rows of section 5 on jumps."""
    (low, low_in), (high, high_in) = crest(published.LOW), crest(published.HIGH)
    inputs = (high_in[0] / low_in[1], high_in[1] / low_in[0])
    result = [Row(
        WHERE, 'Vpp/Vrms, 40 % over 5 %', '', Printed('> 1'), high / low, 'quotient from Table 1',
        f'"From Gaussian noise to impulse disturbances with load" would raise it; it falls from '
        f'{low:.1f} to {high:.1f}, a quotient that half a step of each reading lets lie within '
        f'{inputs[0]:.2f} to {inputs[1]:.2f}.', inputs=inputs, point=8)]
    for state in (published.LOW, published.MEDIUM):
        value, inputs = crest(state)
        for ms in SCREENS_MS:
            best = largest(found, ms)
            result.append(Row(
                WHERE, f'Vpp/Vrms, {state.label}, jumps, {ms} ms screen', '',
                Printed(f'{value:.1f}'), best.mean,
                f'OU with compound Poisson jumps that relax at alpha, best of '
                f'{len(RATES) * len(SHARES)} kinds, Monte Carlo',
                f'On average {best.mean:.1f} at best ({best.band[0]:.1f} to {best.band[1]:.1f}), '
                f'with {best.rate:g} jumps a second of {best.size(state.vrms.value):.0f} mV rms, '
                f'{100 * best.share:.0f} % of the variance, excess kurtosis '
                f'{best.kurtosis:.1f}; impulses too short to count in Vrms would need '
                f'{impulse_height(state, crests):.0f} mV.',
                error=best.error, band=best.band, printed_inputs=inputs, point=8))
    return result
