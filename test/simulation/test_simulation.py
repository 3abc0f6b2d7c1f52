"""Recordings from a model, in pieces."""

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SEGMENT, SupplyModel
from ou_monitor.model.terms.load_answer import LoadSag
from ou_monitor.model.terms.nonlinear_restoring import NonlinearRestoring
from ou_monitor.model.terms.ou import OU
from ou_monitor.simulation import constant, read_profile, simulated
import pytest

SAGGING = SupplyModel((OU(63.0, 0.3, 5.0), LoadSag(0.5, 0.0)))


def test_pieces_have_consecutive_stamps():
    """Together they have the stamps k/rate, and none is longer than a segment."""
    pieces = list(simulated(SAGGING, read_profile('loads'), duration=3.0, rate=50_000.0, seed=1,
                            name='made'))
    assert sum(piece.n for piece in pieces) == 150_000
    assert max(piece.n for piece in pieces) == SEGMENT
    assert {piece.name for piece in pieces} == {'made'}
    np.testing.assert_array_equal(np.concatenate([piece.t for piece in pieces]),
                                  np.arange(150_000) / 50_000.0)


def test_samples_are_those_of_the_model():
    """The same as one run of the model over all stamps, with the same seed."""
    pieces = list(simulated(SAGGING, read_profile('loads'), duration=90.0, rate=1000.0, seed=7))
    t = np.arange(90_000) / 1000.0
    throttle = np.concatenate([piece.throttle for piece in pieces])
    np.testing.assert_array_equal(throttle, read_profile('loads')(t).astype(np.float32))
    np.testing.assert_allclose(
        np.concatenate([piece.voltage for piece in pieces]),
        SAGGING.simulate(t, np.random.default_rng(7), throttle), rtol=0, atol=1e-9)


def test_equal_seeds_give_equal_samples():
    """Another seed gives others; nothing is drawn before it is needed."""
    def first(seed):
        return next(simulated(SAGGING, constant(0.2), duration=1e9, rate=1000.0, seed=seed))

    np.testing.assert_array_equal(first(1).voltage, first(1).voltage)
    assert np.all(first(1).voltage != first(2).voltage)


@pytest.mark.parametrize('terms, words', [
    ((OU(63.0, 1e200, 5.0),), 'beyond 1e\\+09 V'), ((OU(63.0, 0.3, 1e300),), 'beyond'),
    ((OU(1e-300, 1e30, 0.0),), 'beyond'),
    ((OU(63.0, 1e3, 5.0), NonlinearRestoring(-1e6, 1e-3)), 'runs away'),
])
def test_an_impossible_simulation_is_refused(terms, words):
    """One line; no warning of NumPy, no infinity in the recording."""
    with pytest.raises(InputError, match=words):
        list(simulated(SupplyModel(terms), constant(0.0), duration=2.0, rate=1000.0, seed=1))
