"""
What kind of process a load level shows, decided by stated tests only.

The words are those of the paper's Table 1; the paper names the kinds by eye,
here each has a test, in this order:

1. the fit's status decides 'constant', 'quasi-stationary noise' (neighbouring
   samples uncorrelated) and 'undetermined' (too little data);
2. a trend within the segments: 'not stationary';
3. excess kurtosis of the standardised increments above both 4 standard errors
   and `MIN_KURTOSIS`: 'with impulses';
4. relaxation slower than the sampling (alpha dt <= 1) and at least half of the
   variance in it: 'diffusion'; otherwise 'Gaussian'.

Limits: the increments cannot tell impulses from an intensity that wanders.
"""

from __future__ import annotations

import enum
import math

import numpy as np

from ou_monitor.records import Estimate, Flag, FloatArray, NAN, Status

# Below this a significant excess is of no consequence: a Student-t with 16
# degrees of freedom has it, and its 4-sd events are rare.
MIN_KURTOSIS = 0.5
# Increments of an OU in white noise have lag-1 correlation of at most -1/2, so
# the variance of the sample kurtosis is 24/n (1 + 2/16) at most (Lomnicki 1961).
_KURTOSIS_VARIANCE = 24.0 * 1.125
_MIN_INCREMENTS = 50


class ProcessType(enum.Enum):
    """Kind of process; the value is the word for the table."""

    CONSTANT = 'constant'
    NOISE = 'quasi-stationary noise'
    GAUSSIAN = 'Gaussian'
    DIFFUSION = 'diffusion'
    IMPULSES = 'with impulses'
    NOT_STATIONARY = 'not stationary'
    UNDETERMINED = 'undetermined'


def excess_kurtosis(increments: FloatArray) -> tuple[float, float]:
    """
    Return the excess kurtosis of increments about zero and its standard error.

    Parameters
    ----------
    increments : ndarray, shape (n,)
        Increments of the voltage, any unit.

    Returns
    -------
    tuple of float
        Excess kurtosis and the standard error it has for a Gaussian; NaN for
        fewer than 50 increments or when all are 0.

    """
    n = increments.size
    square = float(np.mean(increments ** 2)) if n else 0.0
    if n < _MIN_INCREMENTS or not square > 0.0:
        return NAN, NAN
    return (float(np.mean(increments ** 4)) / square ** 2 - 3.0,
            math.sqrt(_KURTOSIS_VARIANCE / n))


def classify(estimate: Estimate, kurtosis: float, kurtosis_se: float) -> tuple[ProcessType, str]:
    """
    Name the kind of process and the reason, one sentence.

    Parameters
    ----------
    estimate : Estimate
        Estimate of the level.
    kurtosis, kurtosis_se : float
        From `excess_kurtosis`.

    Returns
    -------
    tuple of ProcessType and str
        Kind and reason.

    """
    if estimate.status is Status.CONSTANT:
        return ProcessType.CONSTANT, 'The voltage never changes.'
    if estimate.status is Status.NO_RELAXATION:
        return ProcessType.NOISE, 'Neighbouring samples are uncorrelated.'
    if not estimate.usable:
        return ProcessType.UNDETERMINED, estimate.status.value
    if Flag.TREND in estimate.flags:
        return ProcessType.NOT_STATIONARY, Flag.TREND.value
    tails = f'excess kurtosis of the increments {kurtosis:.2f} +- {kurtosis_se:.2f}'
    if math.isnan(kurtosis):
        tails = 'too few increments to judge their shape'
    if Flag.QUANTIZED in estimate.flags:
        tails = 'steps of the ADC hide the shape of the increments'
    elif kurtosis > max(4.0 * kurtosis_se, MIN_KURTOSIS):
        return (ProcessType.IMPULSES,
                f'Impulses, or an intensity that changes within the level: {tails}.')
    dt = 1.0 / estimate.rate
    if estimate.alpha * dt > 1.0:
        return (ProcessType.GAUSSIAN,
                f'Relaxation is faster than the sampling (alpha dt = {estimate.alpha * dt:.2g}); '
                f'{tails}.')
    noise = estimate.noise_std ** 2
    if noise > estimate.var_inf:
        return (ProcessType.GAUSSIAN,
                f'White noise carries {noise / (noise + estimate.var_inf):.0%} of the '
                f'variance; {tails}.')
    return (ProcessType.DIFFUSION,
            f'Relaxation is resolved (alpha dt = {estimate.alpha * dt:.2g}); {tails}.')
