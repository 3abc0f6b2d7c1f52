"""The throttle that held at a stamp."""

from hypothesis import given, strategies as st
import numpy as np
from ou_monitor.stream.throttle import FEW, hold_last, ThrottleHold
import pytest

STAMPS = st.floats(0.0, 10.0).map(lambda x: round(x, 2))


@given(
    st.lists(st.tuples(STAMPS, st.floats(0.0, 1.0)), max_size=30),
    st.lists(STAMPS, min_size=1, max_size=2 * FEW))
def test_agrees_with_its_definition(pushed, asked):
    """The value of the latest stamp at or before; of equal stamps the later push."""
    hold = ThrottleHold()
    for stamp, value in pushed:
        hold.push(stamp, value)
    expected = []
    for at in asked:
        before = [(stamp, place) for place, (stamp, _) in enumerate(pushed) if stamp <= at]
        expected.append(pushed[max(before)[1]][1] if before else np.nan)
    np.testing.assert_array_equal(hold.at(asked), expected)
    # Few and many stamps go different ways.
    np.testing.assert_array_equal(hold.at(asked * FEW), expected * FEW)


def test_memory_is_bounded():
    """Only the newest are kept; what was forgotten is unknown, not wrong."""
    hold = ThrottleHold(keep=10)
    for k in range(1000):
        hold.push(float(k), k / 1000.0)
    assert len(hold) == 10
    np.testing.assert_array_equal(hold.at([989.5, 990.0, 2000.0]), [np.nan, 0.990, 0.999])


def test_unknown_holds_too():
    """A NaN says "unknown from here on"; a stamp that is none has no place."""
    hold = ThrottleHold()
    hold.push(1.0, 0.5)
    hold.push(2.0, float('nan'))
    hold.push(float('nan'), 0.9)
    np.testing.assert_array_equal(hold.at([1.5, 2.5]), [0.5, np.nan])
    assert len(hold) == 2


def test_scalars_and_nothing():
    """A scalar is one stamp; an empty hold knows nothing."""
    hold = ThrottleHold()
    assert np.isnan(hold.at(1.0)).all() and hold.at(1.0).shape == (1,)
    assert hold.at([]).shape == (0,)
    hold.push(1.0, 0.3)
    assert hold.at(1.0).tolist() == [0.3]
    hold.clear()
    assert np.isnan(hold.at(1.0)[0])


def test_hold_last_on_arrays():
    """The same rule for whole recordings."""
    held = hold_last(np.array([1.0, 2.0]), np.array([0.1, 0.2]), [3.0, 0.5, 1.0, 1.99])
    np.testing.assert_array_equal(held, [0.2, np.nan, 0.1, 0.1])
    assert np.isnan(hold_last(np.empty(0), np.empty(0), [1.0])).all()


def test_keep_below_one():
    """A caller's bug."""
    with pytest.raises(ValueError, match='0'):
        ThrottleHold(keep=0)
