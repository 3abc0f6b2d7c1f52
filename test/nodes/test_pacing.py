"""Waiting, spacing statistics, and reading ahead."""

import threading

from ou_monitor.nodes.player import Prefetch, SpacingError
import pytest


def test_spacing_error_quantiles():
    """99 errors of 1 ms and one of 5 ms: p50 and p99 are 1 ms, max is 5 ms."""
    spacing = SpacingError()
    done = 0.0
    for k in range(101):
        done += 0.010 + (0.005 if k == 40 else 0.001)
        spacing.add(0.010 * k, done)
    assert spacing.summary() == pytest.approx({'p50': 0.001, 'p99': 0.001, 'max': 0.005})


def test_the_gap_between_passes_is_not_counted():
    """Restart begins anew; without any spacing nothing is claimed."""
    spacing = SpacingError()
    spacing.add(0.0, 0.0)
    spacing.restart()
    spacing.add(0.0, 7.0)
    assert spacing.summary() == {}


def test_prefetch_is_bounded_and_fills():
    """`fill` waits for `ahead` batches; the thread then waits too, and `close` ends it."""
    taken = []

    def endless():
        k = 0
        while True:
            taken.append(k)
            yield k
            k += 1
    source = Prefetch(endless(), 10, 3)
    source.fill()
    assert len(taken) == 33
    iterator = iter(source)
    assert [next(iterator) for _ in range(25)] == list(range(25))
    source.close()
    assert 33 <= len(taken) <= 100
    assert 'prefetch' not in [thread.name for thread in threading.enumerate()]


def test_prefetch_raises_where_the_source_did():
    """What was read before is given first."""
    def breaks():
        yield 1
        yield 2
        raise OSError('disk gone')
    source = Prefetch(breaks())
    iterator = iter(source)
    assert [next(iterator), next(iterator)] == [1, 2]
    with pytest.raises(OSError, match='disk gone'):
        next(iterator)
    source.close()
