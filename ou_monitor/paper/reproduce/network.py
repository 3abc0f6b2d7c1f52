"""Sections 4.1, 4.2, 4.5 and 6: capacitance, ESC lines, growth with load."""

from __future__ import annotations

from dataclasses import replace
import math

import numpy as np
from ou_monitor.paper.network.components import PowerNetwork
from ou_monitor.paper.network.rail import Rail, rail_at
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.published import Printed, Row
from ou_monitor.paper.reproduce.table1 import exponent, over, vrms_range
from scipy.linalg import solve_continuous_lyapunov

# An RC rail of any values: Ohm, F, A^2/Hz (two-sided); elasticities do not depend on them.
_R, _C, _S = 0.07, 470e-6, 1e-6


def rc_rail(resistance: float, capacitance: float, density: float) -> tuple[float, float]:
    """Return rate and variance of an RC rail under white current noise (result in 1/s)."""
    a = np.array([[-1.0 / (resistance * capacitance)]])
    b = np.array([[math.sqrt(density) / capacitance]])
    return (float(-np.linalg.eigvals(a)[0].real),
            float(solve_continuous_lyapunov(a, -b @ b.T)[0, 0]))


def doubled(network: PowerNetwork) -> tuple[Rail, Rail]:
    """Return the bus at 40 % throttle, now and with a second capacitor in parallel."""
    more = replace(network, bulk_capacitance=2.0 * network.bulk_capacitance,
                   bulk_esr=0.5 * network.bulk_esr)
    return rail_at(network, published.HIGH.load), rail_at(more, published.HIGH.load)


def _elasticity(before: float, after: float) -> float:
    """Return d ln y / d ln C from a doubling of C."""
    return math.log(after / before) / math.log(2.0)


def share_above(frequency: float) -> float:
    """Return the share of an OU's variance above a frequency, Hz, for the paper's alpha."""
    return 1.0 - 2.0 / math.pi * math.atan(2.0 * math.pi * frequency / published.ALPHA.value)


def rows() -> list[Row]:
    """Return the rows of sections 4.1, 4.2, 4.5 and 6."""
    return [*_hardware(), *_capacitance(), *_growth()]


def _hardware() -> list[Row]:
    low, high = published.ESC_HZ
    nyquist = 0.5 * published.SAMPLING_HZ
    return [
        Row('Section 4.1', 'nominal voltage of 6S', 'V', published.BATTERY_V,
            3.7 * published.BATTERY_CELLS, '6 cells of 3.7 V', 'The arithmetic is right.'),
        Row('Section 4.2', 'Nyquist frequency at 1 MHz', 'kHz', Printed(f'> {1e-3 * high:g}'),
            1e-3 * nyquist, 'half of the sampling frequency',
            f'ESC lines at {1e-3 * low:g} to {1e-3 * high:g} kHz are resolved with '
            f'{int(nyquist / high)} harmonics; of the OU itself {100 * share_above(low):.2g} % of '
            'the variance lies up there.')]


def _capacitance() -> list[Row]:
    one, two = (rc_rail(_R, k * _C, _S) for k in (1.0, 2.0))
    before, after = doubled(PowerNetwork())
    alpha, var = (_elasticity(a, b) for a, b in zip(one, two))
    net_alpha, net_var = (_elasticity(before.alpha, after.alpha),
                          _elasticity(before.var_inf, after.var_inf))
    loop = before.network.battery_resistance + before.network.bulk_esr
    farad = 1.0 / (published.ALPHA.value * loop)
    return [
        Row('Section 4.5', 'd ln alpha / d ln C', '', Printed('> 0'), alpha,
            'eigenvalue of an RC rail, C doubled',
            f'alpha = 1/(R C) falls with C ({net_alpha:+.2f} for a 6S network of typical parts '
            f'with capacitors in parallel, whose alpha is {before.alpha:.2g} 1/s; '
            f'{published.ALPHA.text} 1/s would take {farad:.2g} F there).', point=7),
        Row('Section 4.5', 'd ln Var_inf / d ln C', '', Printed('< 0'), var,
            "Lyapunov's equation of an RC rail under white current noise, C doubled",
            f'The advice is right for another reason: Var_inf = S R/(2 C) falls ({net_var:+.2f} '
            'for that network).', point=7)]


def _growth() -> list[Row]:
    first, first_in = exponent(published.LOW, published.MEDIUM)
    second, second_in = exponent(published.MEDIUM, published.HIGH)
    above = sum(state.load > published.HIGH.load for state in published.TABLE_1)
    ratio = published.HIGH.vrms.value / published.LOW.vrms.value
    return [
        Row('Section 6', 'exponent of sigma in load, 5 -> 10 %', '', Printed('> 1'), first,
            'ln(Vrms quotient) / ln(load quotient)',
            f'Faster than the load: exponent {first:.2f}, {first_in[0]:.2f} to {first_in[1]:.2f} '
            'within half a step of Vrms.', inputs=first_in, point=6),
        Row('Section 6', 'exponent of sigma in load, 10 -> 40 %', '', Printed('> 1'), second,
            'ln(Vrms quotient) / ln(load quotient)',
            f'Towards 40 % sigma grows more slowly than the load: exponent {second:.2f}, '
            f'{second_in[0]:.2f} to {second_in[1]:.2f} within half a step of Vrms.',
            inputs=second_in, point=6),
        Row('Section 6', 'load states measured above 40 %', '', Printed('> 0'), float(above),
            'rows of Table 1', '"40 % and above" is said of nothing that was measured above.',
            point=6),
        Row('Section 8', 'sigma, 40 % over 5 %', '', Printed('> 1'), ratio,
            'quotient of the Vrms', f'Noise grows with load, {ratio:.1f} times in all.',
            inputs=over(vrms_range(published.HIGH), vrms_range(published.LOW)))]
