"""
Numbers as printed in the paper; everything else is computed from them.

Units are the paper's own: mV, ms, 1/s, V/sqrt(s), V^2.
"""

from __future__ import annotations

from dataclasses import dataclass

from ou_monitor.paper.reproduce.row import Printed


@dataclass(frozen=True)
class PrintedLoad:
    """One row of Table 1."""

    load: float  # Share of full throttle, 0..1
    label: str  # Name
    # Peak to peak, peak amplitude and rms, mV.
    vpp: Printed
    amp: Printed
    vrms: Printed
    called: str  # Type of process according to the paper


TABLE_1 = (
    PrintedLoad(0.0, 'motors off', Printed('62.5'), Printed('25.0'), Printed('~0'),
                'quasi-stationary noise'),
    PrintedLoad(0.05, '5 %', Printed('81.3'), Printed('62.5'), Printed('9.38'),
                'Gaussian process'),
    PrintedLoad(0.10, '10 %', Printed('225.0'), Printed('75.0'), Printed('28.1'),
                'stationary stochastic process'),
    PrintedLoad(0.40, '40 %', Printed('287.5'), Printed('66.7'), Printed('56.3'),
                'diffusion process'))
IDLE, LOW, MEDIUM, HIGH = TABLE_1
# Those with a Vrms.
LOADED = (LOW, MEDIUM, HIGH)

# Fig. 5: ms and |U| in mV; the last point is not used by the paper.
FIG_5_MS = (0.0, 10.0, 25.0, 35.0, 50.0)
FIG_5_MV = (Printed('368'), Printed('200'), Printed('80'), Printed('40'), Printed('6'))
FIG_5_USED = 4
TRANSIENT_LOAD = 0.20

# Section 5 and Table 2.
ALPHA = Printed('63.0')
TAU_MS = Printed('15.873')
ROOT_2_ALPHA = Printed('11.22')
SIGMA = {MEDIUM.label: Printed('315.6e-3'), HIGH.label: Printed('632.0e-3')}
VAR_INF = {MEDIUM.label: Printed('7.91e-4'), HIGH.label: Printed('3.17e-3')}

# Where numbers of Table 2 are printed again: section, quantity, number, unit.
RESTATED = (
    ('Section 4.4', 'alpha', Printed('63.0'), '1/s'),
    ('Section 4.4', 'sigma at 40 %', Printed('632.0e-3'), 'V/sqrt(s)'),
    ('Section 4.5', 'alpha', Printed('63.0'), '1/s'),
    ('Section 6', 'sigma at 40 %', Printed('632.0e-3'), 'V/sqrt(s)'),
    ('Section 8', 'alpha', Printed('63.0'), '1/s'))

# Sections 4.1, 4.2 and 4.5: V, Hz.
BATTERY_V, BATTERY_CELLS = Printed('22.2'), 6
SAMPLING_HZ = 1e6
ESC_HZ = (24e3, 48e3)
