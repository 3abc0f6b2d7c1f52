"""The report of `design`: minimum capacitance, a table over capacitances, and alternatives."""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.paper.design import answer, Design, Flight, probability
from ou_monitor.paper.network import PowerNetwork
from ou_monitor.report.document import Document, Figure, Table, Text
from ou_monitor.report.svg import Plot
from ou_monitor.text import counted, number, percent

# Rows of the calculation for each row of the printed table.
_EVERY = 10
# Lower limit of the drawn risk.
_LEAST_RISK = 1e-9


def design_document(result: Design, source: str, taken: str = '') -> Document:
    """Return the report of a design (source: of the limit; taken: what a flight gave, as text)."""
    present = result.present
    chosen = [(present, 'present')]
    if result.least is not None:
        chosen.append((result.least, 'minimum'))
    chosen += [(row, '') for row in result.rows[::_EVERY] if not any(
        math.isclose(row.capacitance, r.capacitance, rel_tol=0.01) for r, _ in chosen)]
    cells = [[number(1e6 * r.capacitance), number(1e3 * r.esr), number(r.alpha),
              number(1e6 * r.tau), number(r.sigma), number(r.var_inf), _time(r.mean_time),
              probability(r.risk_ou), probability(r.risk_crossing), mark]
             for r, mark in sorted(chosen, key=lambda item: item[0].capacitance)]
    name = ('regulated rail' if result.rail != 'bus' else
            'battery bus' if result.network.cells else 'recorded rail')
    sag = 'sag' if result.rail == 'bus' else 'sag of the bus'
    subject = (f'{name} at {percent(result.throttle)} throttle: mean {present.mean:.4g} V ({sag} '
               f'{present.sag:.3g} V), brown-out at {result.voltage:g} V ({source}), '
               f'allowed risk {result.target:g} within {result.horizon:g} s')
    answers = [answer(result)]
    if taken and result.least is not None:
        answers.append(
            'That holds for noise as fast as switching; a recording does not show how fast its '
            'noise is. No capacitor reduces slower noise, or noise of the sensor.')
    return Document('Which capacitance', subject, answers, [
        lambda: [Figure(_risk(result))],
        Table(['C, uF', 'ESR, mOhm', 'alpha, 1/s', 'tau, us', 'sigma, V/sqrt(s)', 'Var_inf, V^2',
               'mean time', 'risk (OU)', 'risk (rate)', ''], cells, left=[9]),
        Text('Mean time: from the mean to the first brown-out. Risk (OU): from the exact first '
             'passage of the OU; risk (rate): from the rate at which the whole noise crosses the '
             'level. The larger risk counts.', legend=True),
        Table(['what', 'unit', 'present', 'tried', 'risk then', f'needed for {result.target:g}'],
              [[lever.name, lever.unit, lever.words(lever.present), lever.words(lever.tried),
                probability(lever.risk), 'none' if lever.least == lever.present else
                lever.words(lever.least) if math.isfinite(lever.least) else 'out of reach']
               for lever in result.levers],
              left=[0, 1]),
        *map(Text, ('' if result.falls else
                    'More capacitance does not always lower the risk here (ESR): choose a value '
                    'from the table.', taken))])


def _risk(result: Design) -> Plot:
    farads = np.array([row.capacitance for row in result.rows])
    risk = np.array([row.risk for row in result.rows])
    plot = Plot('Risk by capacitance', 'bulk capacitance, uF', 'probability', log_x=True,
                log_y=True)
    plot.line(1e6 * farads, np.maximum(risk, _LEAST_RISK), f'within {result.horizon:g} s'
              + f' (drawn at {_LEAST_RISK:g} if below)' * bool((risk < _LEAST_RISK).any()),
              0, 'thick')
    plot.level(1e6 * farads, result.target, 'allowed')
    return plot.mark(1e6 * result.present.capacitance, 'present')


def _time(value: float) -> str:
    return 'never' if value > 1e100 else f'{number(value)} s'


def taken_words(flight: Flight, network: PowerNetwork, throttle: float, assumed: bool,
                origin: str) -> str:
    """Return in words what was taken from a flight, and what is missing (origin: of the cells)."""
    cells = f'{counted(network.cells, "cell")} ({origin})' if network.cells else (
        'taken as a rail, whose regulator is a constant voltage behind a resistance')
    regulator = '' if network.regulator_voltage else (
        ' Regulators on this supply are left out: the recorded voltage includes their effect.')
    sag, se = flight.sag_at(throttle)
    changed = '' if math.isclose(network.battery_voltage, flight.level) else (
        f'; changed to {network.battery_voltage:.4g} V')
    return (f'From the recording: {flight.level:.4g} V without load at its end (by the load model'
            f'{changed}), {cells} (highest median of 0.5 s {flight.full:.4g} V; --cells N for a '
            f'pack of N cells), sag {sag:.3g} V (+- {2.0 * se:.2g} V) and noise '
            f'{1e3 * float(np.interp(throttle, flight.throttle, flight.noise)):.3g} mV rms at '
            f'{percent(throttle)} throttle, resistance '
            + ('unknown without a measured current (--set battery_resistance=OHM): it is shown '
               'relative to the present one.' if assumed else
               f'{1e3 * network.battery_resistance:.3g} mOhm'
               + (f' in place of the recorded {1e3 * flight.resistance:.3g} mOhm, at the recorded '
                  'current.' if flight.resistance > 0.0 and not math.isclose(
                      network.battery_resistance, flight.resistance) else '.'))
            + ('' if math.isfinite(flight.alpha) else ' The flight shows no relaxation: alpha of '
               f'slow noise is assumed to be {number(network.flutter_rate)} 1/s.')
            + ' The risks include the errors of voltage and sag, and are computed as in analyze, '
            'with the sag and noise of each row.' + regulator
            + ' A recording shows neither bulk capacitor nor ESR: state those of the recorded '
            'craft (--set bulk_capacitance=470uF).')
