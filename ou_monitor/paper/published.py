"""
Printed numbers of the paper, and how each is compared with its recomputation.

Units are as in the paper: mV, ms, 1/s, V/sqrt(s), V^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
import enum
import math

from ou_monitor.records import FloatArray

Range = tuple[float, float]

# Tolerance of a recomputed number, standard errors: by chance, one row in 370 exceeds it.
STANDARD_ERRORS = 3.0
# Relative tolerance, so that a number halfway between two roundings agrees with both.
_TIE = 1e-9
# Maximum number of steps tried in the smallest reading of an instrument.
_FINEST = 64


class RowVerdict(enum.Enum):
    """Verdict on a printed number; the value is its wording."""

    AGREES = 'agrees'
    ROUNDING = 'rounding'
    DOES_NOT_HOLD = 'does not hold'


@dataclass(frozen=True)
class Printed:
    """A number of the paper, or a claim as a bound."""

    text: str  # As printed, with all digits (``63.0``), or a bound (``> 0``)
    # Maximum error of rounding, half a unit of the last digit; from the text if left out.
    half_unit: float = math.nan

    def __post_init__(self) -> None:
        """Set the rounding error."""
        last = int(Decimal(self.text.lstrip('<>~ ')).as_tuple().exponent)
        if self.text[0] in '<>':
            object.__setattr__(self, 'half_unit', 0.0)
        elif math.isnan(self.half_unit):
            object.__setattr__(self, 'half_unit', float(Decimal((0, (5,), last - 1))))

    @property
    def value(self) -> float:
        """Return the number itself, or the bound of a claim."""
        return float(self.text.lstrip('<>~ '))

    @property
    def ends(self) -> Range:
        """Range of values that would be printed like this."""
        if self.text[0] == '>':
            return math.nextafter(self.value, math.inf), math.inf
        if self.text[0] == '<':
            return -math.inf, math.nextafter(self.value, -math.inf)
        slack = _TIE * abs(self.value)
        return self.value - self.half_unit - slack, self.value + self.half_unit + slack


@dataclass(frozen=True)
class Row:
    """One printed number, recomputed."""

    where: str  # Table, figure or section of the paper.
    quantity: str
    unit: str  # As in the paper.
    printed: Printed
    recomputed: float  # Recomputed from its inputs, finite.
    how: str  # How it was recomputed.
    sentence: str  # Conclusion.
    error: float | None = None  # Standard error of `recomputed`; None for arithmetic.
    # Range of the recomputed number if it is a random draw, or if its error is not normal;
    # replaces 3 standard errors.
    band: Range | None = None
    # Ranges of the printed and of the recomputed number, each with its own inputs varied within
    # their rounding.
    printed_inputs: Range | None = None
    inputs: Range | None = None
    point: int = 0  # Which of the eight points it belongs to, or 0.

    def __post_init__(self) -> None:
        """Raise ValueError without a number."""
        if not math.isfinite(self.recomputed + (self.error or 0.0)):
            raise ValueError(f'{self.quantity}: {self.recomputed} +- {self.error}')

    @property
    def interval(self) -> Range:
        """Range of the recomputed number: the band, or 3 standard errors each way."""
        if self.band is not None:
            return self.band
        reach = STANDARD_ERRORS * (self.error or 0.0)
        return self.recomputed - reach, self.recomputed + reach

    @property
    def verdict(self) -> RowVerdict:
        if _overlap(self.printed.ends, self.interval):
            return RowVerdict.AGREES
        # Vary the inputs of both numbers within their rounding.
        if _overlap(_join(self.printed.ends, self.printed_inputs),
                    _join(self.interval, self.inputs)):
            return RowVerdict.ROUNDING
        return RowVerdict.DOES_NOT_HOLD


def _overlap(a: Range, b: Range) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _join(a: Range, b: Range | None) -> Range:
    return a if b is None else (min(a[0], b[0]), max(a[1], b[1]))


def over(top: Range, below: Range) -> Range:
    """Return the range of a quotient of two positive ranges."""
    return top[0] / below[1], top[1] / below[0]


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size))


@dataclass(frozen=True)
class ReadingStep:
    """The largest step of which all readings are multiples, within their rounding."""

    # Range of the step, in the unit of the readings.
    low: float
    high: float
    multiples: tuple[int, ...]  # Steps in each reading
    chance: float  # Approximate probability that readings without steps show such a step

    @property
    def size(self) -> float:
        """Middle of the range."""
        return 0.5 * (self.low + self.high)

    def around(self, reading: Printed) -> Range:
        """Return the range of a reading, plus or minus half a step."""
        return reading.value - 0.5 * self.size, reading.value + 0.5 * self.size


def common_step(readings: Sequence[Printed]) -> ReadingStep:
    """Find the step of an instrument from its readings."""
    first, *others = sorted(readings, key=lambda r: r.value)
    for tried in range(1, _FINEST + 1):
        low, high = (end / tried for end in first.ends)
        chance = float(tried)
        for reading in others:
            k = round(reading.value / (0.5 * (low + high)))
            width = 2.0 * (reading.half_unit + first.half_unit * reading.value / first.value)
            chance *= min(1.0, width / (first.value / tried))
            low, high = max(low, reading.ends[0] / k), min(high, reading.ends[1] / k)
            if low > high:
                break
        else:
            size = 0.5 * (low + high)
            return ReadingStep(low, high, tuple(round(r.value / size) for r in readings),
                               min(chance, 1.0))
    raise ValueError('the readings have no common step')


@dataclass(frozen=True)
class PrintedLoad:
    """One row of Table 1."""

    load: float  # Share of full throttle, 0..1
    label: str  # Name
    # Peak to peak, peak amplitude and rms, mV.
    vpp: Printed
    amp: Printed
    vrms: Printed

    @property
    def vrms_range(self) -> Range:
        """Return the range of Vrms, plus or minus half a step of the oscilloscope, mV."""
        return VRMS_STEP.around(self.vrms)

    @property
    def crest(self) -> float:
        """Return Vpp/Vrms."""
        return self.vpp.value / self.vrms.value

    @property
    def crest_range(self) -> Range:
        """Return the range of Vpp/Vrms if either reading is off by up to half a step."""
        return over(VPP_STEP.around(self.vpp), self.vrms_range)

    @property
    def variance(self) -> float:
        """Return Vrms squared, V^2."""
        return (1e-3 * self.vrms.value) ** 2

    @property
    def sigma(self) -> float:
        """Return Vrms sqrt(2 alpha), V/sqrt(s), for the printed Vrms and alpha."""
        return 1e-3 * self.vrms.value * math.sqrt(2.0 * ALPHA.value)


TABLE_1 = (
    PrintedLoad(0.0, 'motors off', Printed('62.5'), Printed('25.0'), Printed('~0')),
    PrintedLoad(0.05, '5 %', Printed('81.3'), Printed('62.5'), Printed('9.38')),
    PrintedLoad(0.10, '10 %', Printed('225.0'), Printed('75.0'), Printed('28.1')),
    PrintedLoad(0.40, '40 %', Printed('287.5'), Printed('66.7'), Printed('56.3')))
IDLE, LOW, MEDIUM, HIGH = TABLE_1
# Load states with a Vrms.
LOADED = (LOW, MEDIUM, HIGH)
# Steps of the oscilloscope, mV.
VPP_STEP = common_step([state.vpp for state in TABLE_1])
VRMS_STEP = common_step([state.vrms for state in LOADED])

# Fig. 5: ms and |U| in mV; the paper leaves out the last point.
FIG_5_MS = (0.0, 10.0, 25.0, 35.0, 50.0)
FIG_5_MV = (Printed('368'), Printed('200'), Printed('80'), Printed('40'), Printed('6'))
FIG_5_USED = 4  # Points that the paper fits
TRANSIENT_LOAD = 0.20  # Throttle before its release

# Section 5 and Table 2.
ALPHA = Printed('63.0')
TAU_MS = Printed('15.873')
ROOT_2_ALPHA = Printed('11.22')
SIGMA = {MEDIUM.label: Printed('315.6e-3'), HIGH.label: Printed('632.0e-3')}
VAR_INF = {MEDIUM.label: Printed('7.91e-4'), HIGH.label: Printed('3.17e-3')}

# Repetitions of numbers of Table 2: section, quantity, number, unit.
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
