"""
Records that all folders share: small, frozen, in SI units.

A record states results and their errors, not how they were computed.  Unknown numbers are NaN,
never 0.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
import enum
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.text import Z95

FloatArray = npt.NDArray[np.float64]

NAN = float('nan')
# A positive parameter is unknown if an end of its 95 % interval is off by more than this factor.
LARGEST_FACTOR = 10.0
# The corresponding standard error of the parameter's logarithm.
LARGEST_LOG_SE = math.log(LARGEST_FACTOR) / Z95
# Maximum exponent of a finite factor: exp(709.78) is the largest float.
_INFINITE = 709.0
# Units of a time, in s.
TIME_UNITS = {'s': 1.0, 'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}
# Start of 2000 and of 2100, s since 1970: in between, the size of a stamp shows its unit.
_CLOCKS = 946_684_800.0, 4_102_444_800.0
# Largest magnitude accepted as a stamp, s: the year 5138; a present date in ms is larger.
MOST_STAMP = 1.0e11
# Plausible median time steps, s; outside, the time unit is wrong: no oscilloscope is faster, no
# logger of a supply is slower.
LEAST_STEP, LONGEST_STEP = 1e-12, 100.0


def plain_data(value: Any) -> Any:
    """Return a value as strict JSON allows it: plain types, None for NaN and infinity."""
    if is_dataclass(value):
        return {one.name: plain_data(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain_data(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain_data(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain_data(item) for item in value]
    if isinstance(value, enum.Enum):
        return value.name
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_numbers(values: npt.ArrayLike) -> FloatArray:
    """Return values as float64, masked ones as NaN; raise ValueError for dates and text."""
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    data = np.asarray(np.ma.getdata(values))
    if data.dtype.kind not in 'biufO':
        raise ValueError(f'numbers are needed, got an array of {data.dtype}')
    try:
        found = np.asarray(data, dtype=np.float64)
    except TypeError as error:
        raise ValueError(f'numbers are needed: {error}') from error
    return np.where(np.ma.getmaskarray(values), NAN, found) if np.ma.isMaskedArray(values) \
        else found


def clock_unit(stamp: float) -> str:
    """Return the unit in which a stamp since 1970 is a date of 2000 to 2100, or ''."""
    return next((unit for unit, scale in TIME_UNITS.items()
                 if _CLOCKS[0] <= stamp * scale <= _CLOCKS[1]), '')


def as_seconds(values: npt.ArrayLike) -> FloatArray:
    """
    Return stamps in s; dates count from 1970 (UTC), NaT and masked stamps become NaN.

    Numbers count as seconds, unless all are dates of 2000 to 2100 in ms, us or ns since 1970.
    Time differences, and dates with a time zone (pandas, xarray), are accepted too.
    """
    plain = type(values) is np.ndarray and values.dtype == np.float64
    data = np.asarray(values if plain else np.ma.getdata(values))
    if data.dtype.kind in 'iuf' and (unit := _fine_unit(data, np.ma.getmask(values))):
        if data.dtype.kind == 'f':
            return as_numbers(values) * TIME_UNITS[unit]
        data = data.astype(f'datetime64[{unit}]')
    elif plain:
        return data
    # NaT is not equal to itself.
    dates = [one for one in data.flat if one == one] if data.dtype.kind == 'O' else []
    if dates and all(hasattr(one, 'timestamp') for one in dates):
        if dates[0].tzinfo is not None:
            return np.array([one.timestamp() if one == one else NAN for one in data.flat]
                            ).reshape(data.shape)
        data = data.astype('datetime64[us]')
    if data.dtype.kind not in 'mM':
        return as_numbers(values)
    if np.datetime_data(data.dtype)[0] == 'generic':
        raise ValueError('stamps without a unit: timedelta64 needs one, such as [ns]')
    # Whole seconds and the rest separately: float64 cannot hold 1.7e18 ns, and int64 ends at 9e18.
    whole = data.astype(f'{data.dtype.kind}8[s]')
    seconds = whole.astype(np.int64) + (data - whole) / np.timedelta64(1, 's')
    return np.where(np.isnat(data) | np.ma.getmask(values), NAN, seconds)


def _fine_unit(stamps: npt.NDArray[Any], masked: npt.NDArray[np.bool_] | np.bool_) -> str:
    """Return 'ms', 'us' or 'ns' if all stamps are dates since 1970 in that unit, else ''."""
    most = float(stamps.max(initial=0))
    # This is false if a stamp is NaN; the finite stamps are then checked below.
    if most <= MOST_STAMP:
        return ''
    known = stamps[np.isfinite(stamps) & ~masked]
    unit = clock_unit(float(known.max(initial=0)))
    if unit in ('', 's') or clock_unit(float(known.min())) != unit:
        return ''
    step = float(np.median(np.abs(np.diff(known.astype(np.float64))))) if known.size > 1 else 0.0
    return unit if step * TIME_UNITS[unit] <= LONGEST_STEP else ''


def exp_or_inf(log: float) -> float:
    """Return ``exp(log)``, infinite where it is too large for a float."""
    return math.inf if log > _INFINITE else math.exp(log)


def log_interval(value: float, log_se: float, z: float = Z95) -> tuple[float, float]:
    """Return the ends ``value * exp(-+z log_se)``; 0 and inf if log_se is infinite."""
    return value * exp_or_inf(-z * log_se), value * exp_or_inf(z * log_se)


def determined(value: float, low: float, high: float) -> bool:
    """Whether both ends of an interval are within a factor `LARGEST_FACTOR` of the value."""
    return low * LARGEST_FACTOR >= value and high <= value * LARGEST_FACTOR


class Status(enum.Enum):
    """
    Outcome of an estimate; the value is the sentence for the pilot.

    The numbers are usable only with `OK` and `SHORT_WINDOW` (`Estimate.usable`); with any other
    status, numbers that could not be estimated are NaN.

    Examples
    --------
    >>> from ou_monitor import Status
    >>> Status.OK.name in Status.__members__
    True
    >>> print(Status.TOO_SHORT.value[:42])
    The window holds too few relaxation times:

    """

    OK = 'Estimate is good.'
    SHORT_WINDOW = (
        'The window holds fewer than 25 relaxation times: alpha is uncertain by more '
        'than a quarter; a longer window, or the same load for longer, helps.')
    NO_DATA = 'No voltage has arrived: check the topic name, the type and the publisher.'
    TOO_FEW_SAMPLES = (
        'Too few samples in the window for a fit: wait, or lengthen the window, or raise '
        'the rate of the voltage topic.')
    CONSTANT = (
        'The voltage does not change at all in the window: the sensor is stuck, or its '
        'step is larger than the noise.')
    TOO_SHORT = (
        'The window holds too few relaxation times: alpha is uncertain by more than a factor '
        'of 10; a longer window, or the same load for longer, helps.')
    UNBOUND = (
        'No restoring force visible: the voltage wanders through the whole window; lengthen '
        'the window, or look for drift and load changes.')
    BURIED = (
        'The relaxation is buried in measurement noise: alpha is uncertain by a factor of more '
        'than 2.6; a longer window, the same load for longer, or a finer ADC helps.')
    NO_RELAXATION = (
        'No relaxation visible at this rate: the noise has no memory, so it comes from the '
        'sensor, or is faster than the sampling. Slow changes count as changes of the level.')
    UNTIMED = (
        'The sample times are not trusted, so no rate can be estimated: see the reason.')


class Severity(enum.IntEnum):
    """Severity of a note."""

    ERROR = 3  # There are no numbers
    WARNING = 2  # The numbers are doubtful
    INFO = 1  # The numbers are valid


class Defect(enum.Enum):
    """Defect that a reader's note reports; the value is its name and severity."""

    DAMAGED_FILE = 'damaged', Severity.WARNING
    GAPS = 'gaps', Severity.WARNING
    UNORDERED = 'unordered', Severity.WARNING
    REPEATED_STAMPS = 'repeated stamps', Severity.WARNING
    NON_FINITE = 'not finite', Severity.WARNING
    DROPPED = 'dropped', Severity.INFO
    READER = 'anything else', Severity.INFO

    @property
    def severity(self) -> Severity:
        """Return the severity."""
        return self.value[1]

    @property
    def drops(self) -> bool:
        """Return whether samples were dropped because of it."""
        return self in (Defect.REPEATED_STAMPS, Defect.NON_FINITE, Defect.DROPPED)


class Note(str):
    """A sentence from the reader of a file, with the defect that it reports."""

    defect: Defect

    def __new__(cls, text: str, defect: Defect = Defect.READER) -> Note:
        """Return the sentence."""
        note = super().__new__(cls, text)
        note.defect = defect
        return note


def defect_of(note: str) -> Defect:
    """Return the defect that a note reports; `Defect.READER` for a plain string."""
    return note.defect if isinstance(note, Note) else Defect.READER


def prefixed(name: str, notes: Iterable[str]) -> list[str]:
    """Return notes with a name before each."""
    return [Note(f'{name}: {note}', defect_of(note)) for note in notes]


class Level(enum.IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


class Flag(enum.Enum):
    """
    A caution about the input; the value is the sentence for the pilot.

    Examples
    --------
    >>> from ou_monitor import Flag
    >>> print(Flag.HELD_SAMPLES.value)
    The source repeats its last value between refreshes; the repeats were dropped.

    """

    SLOW_RATE = (
        'Sampling is slower than the rail (alpha dt > 1): few samples are correlated, so alpha '
        'and sigma are uncertain; raise the rate of the voltage topic.')
    QUANTIZED = (
        'The ADC step is larger than the noise: rounding determines sigma; use a finer ADC range '
        'or AC coupling.')
    LOWPASS_UPSTREAM = (
        'Neighbouring increments rise together, as after a low-pass: something upstream '
        'filters the voltage and sigma is too small; switch that filter off.')
    HELD_SAMPLES = (
        'The source repeats its last value between refreshes; the repeats were dropped.')
    NO_EXCITATION = (
        'Throttle did not move in the window: sag and level cannot be separated.')
    SATURATED = (
        'The voltage sits at the end of the ADC range: the true excursion is larger; '
        'rescale the input.')
    IRREGULAR = 'Samples are irregular or some were lost: see the counters.'
    TREND = (
        'The mean moves within the window in a way that throttle does not explain: alpha '
        'is too low and Var_inf too high.')


@dataclass(frozen=True)
class Counters:
    """Numbers of samples; `pushed` is the sum of `used`, `non_finite`, `late` and `held`."""

    pushed: int = 0  # Given to `push`
    used: int = 0  # Entered the window
    non_finite: int = 0  # NaN or infinite stamps or voltages, dropped
    late: int = 0  # Stamps at or before one already used, dropped
    # Repeats of the last value by a logger that is faster than its source, dropped.  When repeats
    # are first recognised, those in the window are counted; earlier ones stay in `used`.
    held: int = 0
    resets: int = 0  # How often the window was cleared (gap, or a clock that jumped back)


# Parameters of an estimate whose standard errors refer to the logarithm.
LOG_NAMES = ('alpha', 'sigma', 'var_inf')


@dataclass(frozen=True)
class Estimate:
    """
    The OU parameters of the window that ends at `t`.

    dU = -alpha (U - u0) dt + sigma dW, measured with white noise `noise_std`.

    Standard errors of `alpha`, `sigma`, `var_inf` refer to the *logarithm*
    (dimensionless, relative): the 95 % interval is
    ``alpha * exp(+-1.96 * alpha_se)``, see `interval`.  Beyond `LARGEST_LOG_SE`
    the parameter and its error are NaN, and the status says so.  `u0_se` is in volts.

    Attributes
    ----------
    t : float
        Stamp of the newest sample, s.
    alpha : float
        Relaxation rate, 1/s.
    sigma : float
        Noise intensity, V/sqrt(s).
    var_inf : float
        Stationary variance sigma^2 / (2 alpha), V^2.
    u0 : float
        Mean level *at the present throttle*, V.
    noise_std : float
        White measurement noise of one sample, V (0 when none was found).
    alpha_se : float
        Standard error of ln(alpha), dimensionless.
    sigma_se : float
        Standard error of ln(sigma), dimensionless.
    var_inf_se : float
        Standard error of ln(var_inf), dimensionless.
    u0_se : float
        Standard error of u0, V.
    sag : float
        Fall of the mean per unit of throttle at the present throttle, V,
        positive when the supply sags; NaN when throttle did not move.
    voltage : float
        Newest voltage, V.
    throttle : float
        Newest throttle, 0..1; NaN when unknown.
    status : Status
        Outcome of the fit.
    flags : tuple of Flag
        Cautions about the input.
    n : int
        Samples in the window.
    duration : float
        Time spanned by the window, s.
    rate : float
        Mean rate of the samples in the window, Hz.
    counters : Counters
        Samples pushed so far, by outcome.

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor import SlidingEstimator
    >>> estimator = SlidingEstimator(window=1.0)
    >>> estimator.push(np.arange(20) / 1000.0, np.full(20, 5.0))
    >>> estimate = estimator.estimate()
    >>> estimate.usable, estimate.voltage, bool(np.isnan(estimate.alpha))
    (False, 5.0, True)

    """

    t: float = NAN
    alpha: float = NAN
    sigma: float = NAN
    var_inf: float = NAN
    u0: float = NAN
    noise_std: float = NAN
    alpha_se: float = NAN
    sigma_se: float = NAN
    var_inf_se: float = NAN
    u0_se: float = NAN
    sag: float = NAN
    voltage: float = NAN
    throttle: float = NAN
    status: Status = Status.NO_DATA
    flags: tuple[Flag, ...] = ()
    n: int = 0
    duration: float = 0.0
    rate: float = NAN
    counters: Counters = field(default_factory=Counters)

    def __post_init__(self) -> None:
        """Make parameters NaN if their errors exceed `LARGEST_LOG_SE`."""
        wide = [name for name in LOG_NAMES if getattr(self, name + '_se') > LARGEST_LOG_SE]
        if not wide:
            return
        unknown: dict[str, object] = dict.fromkeys(
            [*wide, *(name + '_se' for name in wide), 'u0_se'], NAN)
        if self.status in (Status.OK, Status.SHORT_WINDOW):
            unknown['status'] = (Status.NO_RELAXATION if self.alpha > self.rate
                                 else Status.TOO_SHORT)
        for name, value in unknown.items():
            object.__setattr__(self, name, value)

    @property
    def usable(self) -> bool:
        """Whether the numbers are usable."""
        return self.status in (Status.OK, Status.SHORT_WINDOW) and all(
            map(math.isfinite, (self.alpha, self.sigma, self.var_inf, self.u0)))

    @property
    def tau(self) -> float:
        """Relaxation time 1/alpha, s."""
        return 1.0 / self.alpha if self.alpha > 0.0 else NAN

    def interval(self, name: str, z: float = Z95) -> tuple[float, float]:
        """
        Return the interval of one parameter, symmetric on the log scale.

        Parameters
        ----------
        name : {'alpha', 'sigma', 'var_inf'}
            Parameter.
        z : float
            Half width in standard errors; the default gives 95 %.

        Returns
        -------
        tuple of float
            Lower and upper end, in the parameter's unit; NaN when unknown.

        Raises
        ------
        ValueError
            For a name that has no interval on the log scale.

        """
        if name not in LOG_NAMES:
            raise ValueError(f"no log-scale interval for '{name}': alpha, sigma or var_inf")
        return log_interval(getattr(self, name), getattr(self, name + '_se'), z)


# Lengths of the final part of a recording in which a relaxation is sought, s, and maximum number
# of readings: a minute at 1 kHz.
OU_WINDOWS, MOST_READINGS = (2.0, 8.0, 30.0, 60.0), 65536


@dataclass(frozen=True)
class OuFacts:
    """
    The fitted relaxation (an OU process plus white noise), or bounds on it.

    `not_visible`: a relaxation slower than `tau_below_s` (but faster than the drift of the level)
    has a variance below `var_inf_below` (95 %); a faster one may be all of the noise.
    """

    status: str  # ok, not_visible, too_short or no_data
    window_s: float = NAN  # length of the window at the end of the recording, s
    alpha: float = NAN  # 1/s
    alpha_95: tuple[float, float] = (NAN, NAN)  # 1/s
    sigma: float = NAN  # V/sqrt(s)
    sigma_95: tuple[float, float] = (NAN, NAN)  # V/sqrt(s)
    var_inf: float = NAN  # V^2
    var_inf_95: tuple[float, float] = (NAN, NAN)  # V^2
    tau_below_s: float = NAN  # s
    var_inf_below: float = NAN  # V^2

    def log_se(self, name: str) -> float:
        """Return the standard error of ln of alpha, sigma or var_inf, from its interval."""
        low, high = getattr(self, name + '_95')
        return math.log(high / low) / (2.0 * Z95)


@dataclass(frozen=True, eq=False)
class Recording:
    """
    One recording of a supply, from a file of any format.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Stamps, s, in any order; dates, and numbers since 1970 in ms, us or ns, become seconds.
    voltage : ndarray, shape (n,)
        Voltage, V, finite.
    throttle : ndarray, shape (n,)
        Throttle 0..1, the last value known at each stamp; NaN where unknown, and everywhere
        without a throttle.  A scalar applies to all samples.
    name : str
        Name for messages and pages.
    source : dict
        Topics, types, units and files from which it was read.
    notes : tuple of str
        What the reader dropped or repaired, one sentence each.
    current : ndarray, shape (n,), or None
        Current drawn, A, the last value known at each stamp, NaN where unknown; None: no current.
    held : int
        Number of samples left out because they repeat a reading.

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor import Recording
    >>> voltage, throttle = np.array([5.0, 4.9]), np.array([0.2, np.nan])
    >>> recording = Recording(np.array([0.0, 0.1]), voltage, throttle, 'mine')
    >>> recording.n
    2

    """

    t: FloatArray
    voltage: FloatArray
    throttle: FloatArray = field(default_factory=lambda: np.array(NAN))
    name: str = 'recording'
    source: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    current: FloatArray | None = None
    held: int = 0

    def __post_init__(self) -> None:
        """Convert dates and masked values; refuse arrays that cannot be one recording."""
        if not isinstance(self.name, str):
            raise TypeError(f'name must be a text, got {type(self.name).__name__}: give a current '
                            'as current=')
        # Samples are paired by position: pandas series in different orders would be mixed.
        found: list[Any] = [getattr(given, 'index', None) for given in (
            self.t, self.voltage, self.throttle, self.current)]
        # `index` of a list is a method.
        order = [index for index in found if index is not None and not callable(index)]
        if not all(order[0].equals(other) for other in order[1:]):
            raise ValueError('the series have different indices: align them first')
        object.__setattr__(self, 't', as_seconds(self.t))
        # `abs` would copy the stamps.
        far = (self.t > MOST_STAMP) | (self.t < -MOST_STAMP)
        if (beyond := self.t[np.isfinite(self.t) & far]).size:
            raise ValueError(f'a stamp of {beyond[0]:.4g} s is implausible: give all stamps in s, '
                             'or all as dates')
        if self.throttle is None or np.ndim(self.throttle) == 0:
            object.__setattr__(self, 'throttle', np.full(
                self.t.shape, NAN if self.throttle is None else self.throttle))
        for name in ('voltage', 'throttle', 'current'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, as_numbers(getattr(self, name)))
        if not (self.t.shape == self.voltage.shape == self.throttle.shape and self.t.ndim == 1):
            raise ValueError(
                'a recording needs t, voltage and throttle of one shape (n,); got '
                f'{self.t.shape}, {self.voltage.shape}, {self.throttle.shape}')
        if self.current is not None and self.current.shape != self.t.shape:
            raise ValueError(f'the current must have the shape {self.t.shape} of the stamps, got '
                             f'{self.current.shape}')

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return int(self.t.size)

    @property
    def duration(self) -> float:
        """Time from the earliest to the latest sample, s."""
        known = self.t[np.isfinite(self.t)]
        return float(np.ptp(known)) if known.size else 0.0

    @property
    def has_throttle(self) -> bool:
        """Whether any throttle is known."""
        return bool(np.isfinite(self.throttle).any())
