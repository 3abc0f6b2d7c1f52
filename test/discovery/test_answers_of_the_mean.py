"""What the regression of the mean counts as alike, as next to each other, as a candidate."""

from types import SimpleNamespace

import numpy as np
from ou_monitor.discovery.regression import _candidates, _nearby, _there
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.drift import Drift
from ou_monitor.model.terms.load_sag import LoadSag
from ou_monitor.model.terms.load_transient import LoadTransient
from ou_monitor.model.terms.term import Role
import pytest


def answer(tau, delay=0.0):
    """Return an answer to throttle with a time constant and a delay, s."""
    return LoadTransient(-0.1, tau, delay)


@pytest.mark.parametrize('one, other, near, there', [
    (answer(0.1), answer(0.1), True, True), (answer(0.1), answer(0.14), True, True),
    (answer(0.1), answer(0.16), True, False), (answer(0.16), answer(0.1), True, False),
    (answer(0.1), answer(0.21), False, False), (answer(0.21), answer(0.1), False, False),
    (answer(10.0), answer(12.0), True, True), (answer(10.0), answer(0.09), False, False),
    (answer(0.1), answer(0.1, 0.05), False, False),
    (answer(0.1), LoadSag(0.1, 0.0), False, False),
    (Drift(0.1, 0.0), Drift(-0.2, 0.0), False, True)])
def test_alike_and_next_to_each_other(one, other, near, there):
    """By the ratio of time constants, whichever is longer, at one delay."""
    assert _nearby(one, other) is near
    assert _there(one, [other]) is there
    assert _there(one, [LoadSag(0.1, 0.0), other]) is there
    assert not _there(one, [])


@pytest.mark.parametrize('throttle', [None, np.linspace(0.0, 1.0, 400)])
def test_candidates_are_measured_causes_of_the_mean(throttle):
    """Those that need throttle only where it is known."""
    t = 0.01 * np.arange(400)
    view = SimpleNamespace(t=t, at=t, rate=100.0, throttle=throttle)
    found = list(_candidates(view))
    kinds = {type(term) for term in found}
    wanted = {kind for kind in catalogue().values() if kind.ROLE is Role.MEAN and kind.MEASURED
              and (throttle is not None or not kind.NEEDS_THROTTLE)}
    assert kinds == wanted and (LoadSag in kinds) is (throttle is not None)
