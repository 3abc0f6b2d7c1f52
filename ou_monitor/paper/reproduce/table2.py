"""Table 2, and the repetitions of its numbers."""

from __future__ import annotations

import math

from ou_monitor.model.ou import stationary_variance
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.published import Printed, Row
from ou_monitor.paper.reproduce.table1 import vrms_range, vrms_step
from ou_monitor.paper.reproduce.transient import LogLine, paper_fit

WHERE = 'Table 2'


def sigma_of(state: published.PrintedLoad) -> float:
    """Return Vrms sqrt(2 alpha), V/sqrt(s), for the printed Vrms and alpha."""
    return 1e-3 * state.vrms.value * math.sqrt(2.0 * published.ALPHA.value)


def sigma_half_width(state: published.PrintedLoad, line: LogLine) -> float:
    """
    Return the uncertainty of sigma, V/sqrt(s).

    Half a step of Vrms and half of the 95 % interval of alpha, in quadrature.
    """
    reading = 0.5 * vrms_step().size / state.vrms.value
    rate = 0.5 * line.half_width / line.alpha
    return sigma_of(state) * math.hypot(reading, rate)


def rows() -> list[Row]:
    """Return the rows of Table 2 and of the sections that repeat it."""
    alpha = published.ALPHA.value
    root = math.sqrt(2.0 * alpha)
    found = [
        Row('Section 5', 'sqrt(2 alpha)', '1/sqrt(s)', published.ROOT_2_ALPHA, root,
            f'sqrt(2 x {published.ALPHA.text})', 'The arithmetic is right.'),
        Row(WHERE, 'tau', 'ms', published.TAU_MS, 1e3 / alpha, f'1 / {published.ALPHA.text}',
            'The arithmetic is right; its five digits come from the division; alpha has fewer.')]
    for state in (published.MEDIUM, published.HIGH):
        found += _of_load(state)
    return found + _repetitions()


def _of_load(state: published.PrintedLoad) -> list[Row]:
    sigma, printed = sigma_of(state), published.SIGMA[state.label]
    half = 1e-3 * state.vrms.half_unit * math.sqrt(2.0 * published.ALPHA.value)
    step = vrms_step()
    whole = 1e-3 * round(state.vrms.value / step.size) * step.low * published.ROOT_2_ALPHA.value
    width = sigma_half_width(state, paper_fit())
    low, high = vrms_range(state)
    var = stationary_variance(published.ALPHA.value, printed.value)
    return [
        Row(WHERE, f'sigma, {state.label}', 'V/sqrt(s)', printed, sigma,
            f'Vrms sqrt(2 alpha) with {state.vrms.text} mV',
            f'{sigma:.5f} from the rounded Vrms; whole steps of {step.low:.3f} mV times '
            f'{published.ROOT_2_ALPHA.text} give {whole:.5f}.',
            inputs=(sigma - half, sigma + half)),
        Row(WHERE, f'implied error, {state.label}', 'V/sqrt(s)',
            Printed(f'{printed.half_unit:.2g}', 0.0), width,
            'half a step of Vrms and the 95 % interval of alpha, in quadrature',
            f'sigma is {sigma:.2f} +- {width:.2f} V/sqrt(s), {100.0 * width / sigma:.0f} %, where '
            'four digits are printed.', point=4),
        Row(WHERE, f'Var_inf, {state.label}', 'V^2', published.VAR_INF[state.label], var,
            'sigma^2 / (2 alpha) with the printed numbers',
            f'The arithmetic is right; half a step of Vrms allows {1e-6 * low ** 2:.2g} to '
            f'{1e-6 * high ** 2:.2g} V^2.')]


def _repetitions() -> list[Row]:
    line = paper_fit()
    said = {
        'Section 4.5': 'The number, from Fig. 5, shows a limit of the filtration only if the '
                       'network, and not the oscilloscope, set it.',
        'Section 8': 'The number is from Fig. 5, and a rate alone does not confirm an OU: every '
                     'first-order system has one, AC coupling included.'}
    return [Row(
        where, quantity, unit, printed,
        line.alpha if quantity == 'alpha' else sigma_of(published.HIGH),
        'least squares, as for Fig. 5' if quantity == 'alpha' else 'Vrms sqrt(2 alpha)',
        said.get(where, 'The same number as in Table 2.'))
        for where, quantity, printed, unit in published.RESTATED]
