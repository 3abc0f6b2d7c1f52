"""Series behind the figures of the report: screens, transient, spectra, crest factors."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.criticism.curves import even_on_log
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ac_coupling import ACCoupling
from ou_monitor.model.terms.ou import OU
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.table1 import vpp_step, vrms_step
from ou_monitor.paper.reproduce.table2 import sigma_of
from ou_monitor.paper.reproduce.transient import CORNER_HZ
from ou_monitor.records import FloatArray
from scipy.signal import welch

# Length of a drawn screen, s.
SCREEN = 0.1
# For the spectrum: length, s, and points a decade.
_SPECTRUM, _PER_DECADE = 2.0, 12


@dataclass(frozen=True, eq=False)
class Screen:
    """One simulated oscilloscope screen."""

    state: published.PrintedLoad  # The row of Table 1 it stands for
    # s and V, in steps of the oscilloscope; shape (n,).
    t: FloatArray
    u: FloatArray


@dataclass(frozen=True, eq=False)
class DrawnSpectrum:
    """One-sided density of a load state."""

    state: published.PrintedLoad  # The row of Table 1 it stands for
    # Hz and V^2/Hz, of a simulated recording at 1 MHz; shape (k,).
    frequency: FloatArray
    density: FloatArray
    coupled: FloatArray  # Of the same OU through an AC coupling of 10 Hz, V^2/Hz; shape (k,)


@dataclass(frozen=True, eq=False)
class Figures:
    """All series."""

    screens: tuple[Screen, ...]  # One a load state
    spectra: tuple[DrawnSpectrum, ...]  # Of 10 and 40 %


def sigma_shown(state: published.PrintedLoad) -> float:
    """Return the sigma to draw, V/sqrt(s); motors off, half a step of Vrms."""
    if state is published.IDLE:
        return 0.5e-3 * vrms_step().size * math.sqrt(2.0 * published.ALPHA.value)
    return sigma_of(state)


def lorentzian(frequency: FloatArray, alpha: float, sigma: float) -> FloatArray:
    """Return the one-sided density of an OU (frequency in Hz)."""
    return np.asarray(2.0 * sigma ** 2 / (alpha ** 2 + (2.0 * math.pi * frequency) ** 2))


def draw(rng: np.random.Generator) -> Figures:
    """Simulate what the figures show."""
    t = np.arange(round(SCREEN * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    step = 1e-3 * vpp_step().size
    screens = tuple(
        Screen(state, t, step * np.round(
            simulate(t, published.ALPHA.value, sigma_shown(state), rng) / step))
        for state in published.TABLE_1)
    return Figures(screens, tuple(
        _spectrum(state, rng) for state in (published.MEDIUM, published.HIGH)))


def _spectrum(state: published.PrintedLoad, rng: np.random.Generator) -> DrawnSpectrum:
    """Return the spectrum of a simulated recording at 1 MHz, even on a log axis."""
    t = np.arange(round(_SPECTRUM * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    ou = OU(published.ALPHA.value, sigma_of(state), 0.0)
    plain = _density(simulate(t, ou.alpha, ou.sigma, rng))
    coupled = _density(SupplyModel((ou, ACCoupling(CORNER_HZ, 0.0))).simulate(t, rng))
    return DrawnSpectrum(state, plain[0], plain[1], coupled[1])


def _density(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    frequency, density = welch(u, published.SAMPLING_HZ, nperseg=u.size // 4)
    return even_on_log(frequency[2:-1], density[2:-1], _PER_DECADE)
