"""Terms with ordinary parameters, and the statistics that the tests of terms share."""

import math

import numpy as np
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue

ALPHA, SIGMA, U0 = 63.0, 0.632, 5.0
OU = {'alpha': ALPHA, 'sigma': SIGMA, 'u0': U0}

# One of each, all with an effect.
EXAMPLES = {
    'ou': OU,
    'load_sag': {'linear': 0.3, 'square': 0.1, 'growth': -0.02},
    'load_transient': {'gain': -0.2, 'tau': 0.03, 'delay': 0.0125, 'rise': 0.1,
                       'square': -0.3, 'lagged': 0.2},
    'load_dependent_sigma': {'throttle': [0.0, 0.4, 1.0], 'log_factor': [0.0, 0.7, 0.4]},
    'load_dependent_alpha': {'slope': 0.8, 'sigma_slope': 0.4},
    'load_dependent_noise': {
        'number': [0, 0, 0, *np.repeat(np.arange(1, 11), 2).tolist()],
        'at': [0.0, 0.5, 1.0, *[0.0, 0.2] * 9, -0.6, 1.5],
        'log_factor': [0.0, 0.8, 1.0, *[0.0, 0.3, 0.0, -0.2, 0.0, 0.4] * 3, -0.6, 1.2],
        'on_sigma': 0.6},
    'drift': {'rate': -0.01, 'curvature': 0.002, 'charge': -0.02},
    'measurement_noise': {'std': 0.02},
    'lopsided_noise': {'skew': -0.4, 'tail': 0.9},
    'quantization': {'step': 0.01},
    'held_samples': {'rate': 270.0},
    'saturation': {'low': 4.9, 'high': 5.1},
    'second_relaxation': {'alpha': 4.0, 'sigma': 0.1},
    'resonance': {'frequency': 120.0, 'damping': 40.0, 'std': 0.03, 'tilt': -0.5},
    'tone': {'amplitude': 0.05, 'frequency': 50.0, 'phase': 0.4, 'linewidth': 2.0},
    'throttle_tone': {
        'amplitude': 0.05, 'idle': 20.0, 'slope': 300.0, 'phase': 0.1, 'linewidth': 0.0},
    'ac_coupling': {'corner': 7.0, 'offset': 0.5},
    'jumps': {'rate': 30.0, 'mean': -0.05, 'std': 0.02},
    'heavy_tails': {'dof': 5.0},
    'glitches': {'probability': 0.05, 'std': 0.3},
    'regime_switching': {'rate_up': 20.0, 'rate_down': 50.0, 'level': -0.1, 'sigma_ratio': 2.0,
                         'at_once': 0.5, 'states': 3.0},
    'volatility': {'std': 0.4, 'rate': 5.0},
    'nonlinear_restoring': {'square': 100.0, 'cube': 3000.0},
    'flicker_noise': {'amplitude': 0.02, 'low': 0.5, 'high': 200.0},
    'clock_jitter': {'std': 2e-4},
}


def term(name, **params):
    return catalogue()[name](**params)


def supply(*others, **ou):
    """Return a model: the `ou` of this module, changed by keywords, and other terms."""
    return SupplyModel((term('ou', **{**OU, **ou}), *others))


def still(*others, alpha=ALPHA):
    """Return a model whose `ou` has no effect, so that only the other terms are seen."""
    return supply(*others, alpha=alpha, sigma=0.0, u0=0.0)


def clusters(model, offsets, gap, count, seed, throttle=None):
    """
    Draw `count` groups of samples, far enough apart to be independent.

    Returns
    -------
    ndarray, shape (count, len(offsets))
        Voltage, V, without the first group.
    """
    t = (np.arange(count + 1)[:, None] * gap + np.asarray(offsets)[None, :]).ravel()
    voltage = model.simulate(t, np.random.default_rng(seed), throttle)
    return voltage.reshape(count + 1, -1)[1:]


def agrees(found, truth, error, change=0.05):
    """Return whether an estimate is within 4 standard errors of the truth."""
    # First checks the power: a truth changed by the share `change` must be 6 standard errors away,
    # so that it is rejected in 97.7 of 100 cases. An infinite `change` requires no power.
    if math.isfinite(change):
        assert 6.0 * error <= change * abs(truth), f'no power: {6 * error / abs(truth):.3f}'
    assert abs(found - truth) < 4.0 * error, (
        f'{found:.6g} is not {truth:.6g}: {(found - truth) / error:+.1f} standard errors')


def has_covariance(groups, offsets, cov, change=0.05):
    """Check all second moments of independent groups of a zero-mean process."""
    # `cov` is the autocovariance as a function of the lag. The standard error of the mean of M
    # products is their standard deviation / sqrt(M). Moments that are small against the variance
    # have the same error but too little power; they must only be within 4 errors.
    for j, early in enumerate(offsets):
        for k in range(j, len(offsets)):
            product = groups[:, j] * groups[:, k]
            error = float(product.std()) / math.sqrt(len(product))
            truth = cov(offsets[k] - early)
            small = abs(truth) < 0.5 * cov(0.0)
            agrees(float(product.mean()), truth, error, math.inf if small and truth else change)
