"""The start of a series: the law of the first sample, and models that cannot be simulated."""

import math

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import columns_of, evaluate, state_space
from ou_monitor.discovery.decision import rivals_of, TIE
from ou_monitor.model.terms.load_response import LoadDependentAlpha, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import ACCoupling


def test_the_first_sample_behind_a_high_pass_has_the_law_of_its_throttle():
    n = 50
    throttle = np.linspace(0.1, 0.9, n)
    samples = Samples(1e-3 * np.arange(n), np.random.default_rng(1).standard_normal(n), throttle)
    ou, alpha = OU(60.0, 0.5, 5.0), LoadDependentAlpha(0.8)
    plain = evaluate(samples, (ou, alpha))
    space = state_space(samples, (ou, alpha, ACCoupling(3.0, 0.0)), None)[1]
    rate = 2.0 * math.pi * 3.0
    first = float(plain.variance[0])
    # The same step from the first sample to the second says what alpha is at the first.
    at_first = -1e3 * math.log(state_space(samples, (ou, alpha), None)[1].f[1, 0, 0])
    share = rate / (rate + at_first)
    assert_allclose(space.q[0] / first, [[1.0, share], [share, share]], rtol=0.02)
    late = -1e3 * math.log(state_space(samples, (ou, alpha), None)[1].f[-1, 0, 0])
    assert abs(rate / (rate + late) / share - 1.0) > 0.1


def test_rivals_are_within_a_tie():
    evidence = [('a', 5.0 + TIE), ('b', 5.0), ('c', 5.0 + 0.01), ('d', 9.0 + TIE)]
    assert rivals_of('a', evidence) == ['c', 'd'] and rivals_of('d', evidence) == []


def test_the_mean_is_seen_through_the_instrument():
    """Columns of the load are high-passed; that of the level is the instrument's own."""
    t = 0.01 * np.arange(300)
    u = np.where(t >= 1.0, 0.8, 0.2)
    samples = Samples(t, 5.0 - u, u)
    ou, sag, coupling = OU(60.0, 0.5, 5.0), LoadSag(0.3, 0.1), ACCoupling(2.0, 0.0)
    s = samples.segment(60.0, 0.5)
    bare = columns_of(samples, (ou, sag), s)
    shown = columns_of(samples, (ou, sag, coupling), s)
    assert bare.shape == shown.shape == (300, 3)
    assert_allclose(shown[:, 0], 1.0)
    assert_allclose(shown[:, 1:], coupling.pass_through(bare[:, 1:], s), atol=1e-12)
    assert np.abs(shown[:90, 1:]).max() < 1e-9 < np.abs(bare[:90, 1:]).min()
    # What is kept from before is not touched.
    assert_allclose(columns_of(samples, (ou, sag), s), bare)
