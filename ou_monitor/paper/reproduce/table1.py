"""Table 1: the steps of the oscilloscope, what Amp can be, how loads compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.published import Printed, Range, Row
from ou_monitor.text import counted

WHERE = 'Table 1'
# Finest step tried: the smallest reading over this.
_FINEST = 64


@dataclass(frozen=True)
class ReadingStep:
    """The largest step of which all readings are multiples, within their rounding."""

    # Range of the step, in the unit of the readings.
    low: float
    high: float
    multiples: tuple[int, ...]  # Steps in each reading
    chance: float  # Approximate probability that readings without steps show one this large

    @property
    def size(self) -> float:
        """Middle of the range."""
        return 0.5 * (self.low + self.high)


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


def vpp_step() -> ReadingStep:
    """Return the step of Vpp, mV."""
    return common_step([state.vpp for state in published.TABLE_1])


def vrms_step() -> ReadingStep:
    """Return the step of Vrms, mV."""
    return common_step([state.vrms for state in published.LOADED])


def vrms_range(state: published.PrintedLoad) -> Range:
    """Return Vrms of a load state, mV, half a step each way."""
    half = 0.5 * vrms_step().size
    return state.vrms.value - half, state.vrms.value + half


def vpp_range(state: published.PrintedLoad) -> Range:
    """Return Vpp of a load state, mV, half a step each way."""
    half = 0.5 * vpp_step().size
    return state.vpp.value - half, state.vpp.value + half


def over(top: Range, below: Range) -> Range:
    """Return the range of a quotient of two positive ranges."""
    return top[0] / below[1], top[1] / below[0]


def rows(white_crest: float, white_crest_se: float) -> list[Row]:
    """Return the rows of Table 1 without the crest factors."""
    return [*_vpp(), _idle(white_crest, white_crest_se), *_vrms(), *_amp(), *_grades()]


def _vpp() -> list[Row]:
    step = vpp_step()
    return [Row(
        WHERE, f'Vpp, {state.label}', 'mV', state.vpp, k * step.size,
        f'multiple of a common step of {step.low:.4g} to {step.high:.4g} mV',
        f'{k} steps, so it is known to half a step, {50.0 * step.size / state.vpp.value:.2g} %.',
        point=4) for state, k in zip(published.TABLE_1, step.multiples)]


def _vrms() -> list[Row]:
    step = vrms_step()
    return [Row(
        WHERE, f'Vrms, {state.label}', 'mV', state.vrms, k * step.size,
        f'multiple of a common step of {step.low:.4g} to {step.high:.4g} mV',
        f'{counted(k, "step")}, so Vrms and sigma are known to half a step, '
        f'{50.0 * step.size / state.vrms.value:.2g} %.',
        point=4) for state, k in zip(published.LOADED, step.multiples)]


def _idle(crest: float, crest_se: float) -> Row:
    step = vrms_step().size
    lowest = published.IDLE.vpp.value / crest
    return Row(
        WHERE, 'Vrms, motors off', 'mV', Printed(published.IDLE.vrms.text, 0.5 * step), lowest,
        'Vpp over the crest factor of white Gaussian noise, 100 ms at 1 MHz, Monte Carlo',
        f'Gaussian noise with this Vpp on 100 ms has about {lowest:.1f} mV or more, whatever '
        f'its colour; one step is {step:.2f} mV, so "~0" is a reading, not the absence of noise.',
        error=lowest * crest_se / crest, printed_inputs=(0.0, step), point=4)


def _amp() -> list[Row]:
    half = 0.5 * vpp_step().size
    found = []
    for state in published.TABLE_1:
        vpp = state.vpp.value
        found.append(Row(
            WHERE, f'Amp, {state.label}', 'mV', state.amp, 0.5 * vpp,
            'max |u| of a trace through zero lies between Vpp/2 and Vpp',
            f'A peak of {state.amp.value:g} mV beside Vpp/2 = {0.5 * vpp:g} mV: '
            + ('possible.' if state.amp.value >= 0.5 * vpp else
               'a trace cannot be wider than twice its peak, so Amp is something else (such as '
               'top minus base).'),
            band=(0.5 * vpp, vpp), inputs=(0.5 * (vpp - half), vpp + half)))
    return found


def _grades() -> list[Row]:
    step = vrms_step().size
    below = 0.5 * step
    ratio = published.HIGH.vrms.value / published.MEDIUM.vrms.value
    low, high = over(vrms_range(published.HIGH), vrms_range(published.MEDIUM))
    found = [Row(
        WHERE, f'{name}: {state.label} over motors off', '', Printed('> 1'),
        state.vrms.value / below, 'Vrms over half a step, the most that reads as zero',
        'The order holds; the factor is a lower bound, because V0 is only known to read as zero.',
        inputs=over(vrms_range(state), (below, step)))
        for name, state in (('V1 > V0', published.LOW), ('V2 >> V0', published.MEDIUM))]
    found.append(Row(
        WHERE, 'V3 >> V2: 40 % over 10 %', '', Printed('> 1'), ratio, 'quotient of the Vrms',
        f'The order holds; the factor is {ratio:.1f} ({low:.1f} to {high:.1f} within half a '
        'step), which is hardly ">>".', inputs=(low, high)))
    return found


def exponent(low: published.PrintedLoad, high: published.PrintedLoad) -> tuple[float, Range]:
    """Return the growth of sigma with load: d ln sigma / d ln load between two states."""
    span = math.log(high.load / low.load)
    ends = over(vrms_range(high), vrms_range(low))
    return (math.log(high.vrms.value / low.vrms.value) / span,
            (math.log(ends[0]) / span, math.log(ends[1]) / span))
