"""First-order recursions against a plain loop."""

import numpy as np
from ou_monitor.model.terms.segment import first_order, steady
import pytest


def loop(phi, e, before):
    """Return the recursion step by step."""
    x = np.empty(e.size)
    for k in range(e.size):
        before = phi[k] * before + e[k]
        x[k] = before
    return x


@pytest.mark.parametrize('n', [0, 1, 2, 3, 1000])
@pytest.mark.parametrize('kind', ['equal', 'first differs', 'last differs', 'all differ'])
def test_against_a_loop(n, kind):
    """One coefficient or many, one sample or many; the caller's arrays stay."""
    rng = np.random.default_rng(1)
    phi = np.full(n, 0.97)
    if kind == 'all differ':
        phi = rng.random(n)
    elif n and kind != 'equal':
        phi[0 if kind == 'first differs' else -1] = 0.5
    e = rng.standard_normal(n)
    kept = phi.copy(), e.copy()
    np.testing.assert_allclose(first_order(phi, e, 3.0), loop(phi, e, 3.0), rtol=1e-12,
                               atol=1e-13)
    np.testing.assert_array_equal(phi, kept[0])
    np.testing.assert_array_equal(e, kept[1])


def test_steady():
    """One number seen many times, a value in the midst, the last, none."""
    assert steady(np.empty(0))
    assert steady(np.ones(5))
    assert steady(np.broadcast_to(2.0, 5))
    assert not steady(np.array([1.0, 1.0, 2.0, 1.0]))
    assert not steady(np.array([1.0, 1.0, 2.0]))
    assert not steady(np.array([np.nan, 1.0]))
