"""Publishers of messages, losses, and the age of the newest sample."""

import numpy as np
from ou_monitor.stream.samples import Publishers, SourceClock
import pytest


def sent(first, n, rate, start, lost=()):
    """Return (number, time) of a publisher's messages, less those that are lost."""
    return [(first + k, start + k / rate) for k in range(n) if k not in lost]


def follow(publishers, *streams, count, batch=20):
    """Feed messages of publishers as they arrive; return whose were kept: {stream: number}."""
    merged = sorted((time, number, who) for who, stream in enumerate(streams)
                    for number, time in stream)
    kept = dict.fromkeys(range(len(streams)), 0)
    for k in range(0, len(merged), batch):
        part = merged[k:k + batch]
        times = np.array([time for time, _, _ in part])
        mask = publishers.follow([number for _, number, _ in part], times, times, count)
        for (_, _, who), keep in zip(part, mask.tolist()):
            kept[who] += keep
    return kept


def test_losses_of_one_publisher_are_counted():
    """Every tenth message is lost; a restart is not a loss."""
    publishers = Publishers()
    assert follow(publishers, sent(1, 1000, 1e3, 0.0, set(range(5, 1000, 10))),
                  count=1) == {0: 900}
    assert publishers.lost == 100 and publishers.foreign == 0
    follow(publishers, sent(1, 100, 1e3, 5.0), count=1)
    assert publishers.lost == 100 and publishers.numbered


@pytest.mark.parametrize('offset', [0, 3, 700])
@pytest.mark.parametrize('rate', [1000.0, 137.0])
def test_the_first_of_two_publishers_is_followed(offset, rate):
    """Whatever their numbers, with a pause that loses the messages of both."""
    publishers = Publishers()
    gap = set(range(1000, 1030))
    first = sent(1 + offset, 3000, 1000.0, 0.0, gap)
    other = sent(1, int(3 * rate), rate, 0.0004, {k for k in range(int(3 * rate))
                                                  if 1.0 <= k / rate < 1.03})
    kept = follow(publishers, first, other, count=2)
    assert kept[0] >= 2960 and kept[1] <= 10
    assert publishers.foreign >= len(other) - 10 and abs(publishers.lost - 30) <= 10


def test_a_later_publisher_is_ignored():
    publishers = Publishers()
    kept = follow(publishers, sent(1, 1000, 1e3, 0.0), count=1)
    kept = follow(publishers, sent(1001, 1000, 1e3, 1.0), sent(1, 900, 1e3, 1.1003), count=2)
    assert kept == {0: 1000, 1: 0} and publishers.foreign == 900


def test_if_the_first_publisher_ends_the_other_is_followed():
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 100, 100.0, 0.0004), count=2)
    kept = follow(publishers, sent(101, 500, 100.0, 1.0004), count=2)
    assert 380 <= kept[0] <= 420


def test_without_sequence_numbers_losses_are_unknown():
    publishers = Publishers()
    assert publishers.follow([None] * 3, np.arange(3.0), np.arange(3.0), 2).all()
    assert not publishers.numbered


def test_age_counts_from_the_stamp_of_the_nodes_clock():
    clock = SourceClock()
    assert clock.name == 'unknown' and clock.age(5.0) is None
    clock.take(np.array([100.0, 100.1]), np.array([100.11, 100.11]), 5.0)
    assert clock.name == 'ros' and clock.age(5.0) == pytest.approx(0.01)
    assert clock.age(6.0) == pytest.approx(1.01)
    # A backlog: data 8 s old that have just arrived.
    clock.take(np.array([103.0]), np.array([111.0]), 16.0)
    assert clock.name == 'ros' and clock.age(16.0) == pytest.approx(8.0)


@pytest.mark.parametrize('stamp', [12.0, 1.7e9 + 3.0, 1.7e9 - 20.0])
def test_age_counts_from_arrival_for_a_foreign_clock(stamp):
    clock = SourceClock()
    clock.take(np.array([stamp]), np.array([1.7e9]), 5.0)
    assert clock.name == 'foreign' and clock.age(5.5) == pytest.approx(0.5)


def test_a_clock_set_during_the_run_is_the_nodes():
    clock = SourceClock()
    clock.take(np.array([12.0]), np.array([1.7e9]), 5.0)
    clock.take(np.array([1.7e9]), np.array([1.7e9 + 0.01]), 6.0)
    assert clock.name == 'ros'


@pytest.mark.parametrize('first', [0, 1])
def test_after_a_stall_the_first_publisher_is_still_followed(first):
    """Both were silent for 1.5 s, as everything was; whose message comes first decides nothing."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 200, 200.0, 0.0004), count=2)
    kept = follow(publishers, sent(2500 + first, 1000, 1e3, 2.5 + 1e-3 * first),
                  sent(500, 200, 200.0, 2.4994 + 1e-3), count=2, batch=50)
    assert kept[0] >= 990 and kept[1] <= 10


@pytest.mark.parametrize('pause', [0.2, 0.6, 3.0])
def test_first_publisher_is_followed_after_a_pause(pause):
    """Its numbers go on where they were; the other begins meanwhile, or after."""
    publishers = Publishers()
    follow(publishers, sent(1, 400, 500.0, 0.0), count=2)
    start = 0.8 + pause
    kept = follow(publishers, sent(401, 500, 500.0, start), sent(1, 100, 100.0, start + 0.0005),
                  count=2, batch=6)
    assert kept == {0: 500, 1: 0} and publishers.foreign == 100


def test_two_restarted_publishers_are_told_apart():
    """The first ends and restarts beside another: it is followed within a batch."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 100, 100.0, 0.0004), count=2)
    kept = follow(publishers, sent(1, 1000, 1e3, 1.5), sent(101, 150, 100.0, 1.0004), count=2)
    assert kept[0] + kept[1] >= 900


def test_restart_of_the_only_publisher_counts_no_loss():
    """Another was there before; behind a silence its first messages, many at once, are kept."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 200, 200.0, 0.0004), count=2)
    follow(publishers, sent(1001, 1000, 1e3, 1.0), count=1)
    foreign = publishers.foreign
    kept = follow(publishers, sent(1, 2000, 1e3, 4.0), count=1, batch=2000)
    assert kept[0] == 2000 and publishers.foreign == foreign


def test_sequence_numbers_in_any_order_are_handled_fast():
    """Each smaller than the one before, as of publishers without end: no more tracks than that."""
    publishers = Publishers()
    times = np.arange(2000) * 1e-3
    publishers.follow(list(range(4000, 2000, -1)), times, times, 2)
    assert publishers.foreign >= 1990
