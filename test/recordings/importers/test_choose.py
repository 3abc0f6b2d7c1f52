"""Selection of series from a log, and unusable or repeated samples."""

from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.log import (
    clean, CURRENT, Log, log_of, Series, THROTTLE, VOLTAGE)
import pytest

PATH = Path('a.ulg')


def series(name='v', quantity=VOLTAGE, t=(0.0, 1.0, 2.0), values=(5.0, 5.1, 5.2), rank=0,
           group=''):
    return Series(name, quantity, np.array(t), np.array(values), '1', 'words', rank, group)


def test_the_smallest_rank_is_the_default():
    log = Log('x', (series('a', rank=None), series('b', rank=1), series('c', rank=0)))
    assert choose(PATH, log).voltage.name == 'c'
    assert choose(PATH, log, voltage='a').voltage.name == 'a'
    with pytest.raises(InputError, match='no battery voltage.*a '):
        choose(PATH, Log('x', (series('a', rank=None),)))


def test_an_unknown_name_is_refused_with_the_nearest():
    log = Log('x', (series('battery'), series('gas', THROTTLE)))
    with pytest.raises(InputError, match="did you mean 'battery'"):
        choose(PATH, log, voltage='batery')
    with pytest.raises(InputError, match="'gas' is a throttle, not a voltage"):
        choose(PATH, log, voltage='gas')
    assert choose(PATH, log, throttle='none').throttle is None


def test_a_name_lost_with_the_end_of_a_log():
    """The error about the missing name also says how far the log was read."""
    log = Log('x', (), notes=('The log was cut off at byte 7.',))
    with pytest.raises(InputError, match=r"no voltage 'v': there is none \(The log was cut off"):
        choose(PATH, log, voltage='v')


def test_values_that_no_message_holds_are_dropped():
    mended, notes = clean(series(values=(5.0, 1e300, 5.2)))
    assert mended.values.tolist() == [5.0, 5.2] and 'beyond 1e+09' in notes[0]


def test_two_throttles_of_one_rank_need_a_choice():
    log = Log('x', (series(), series('a', THROTTLE), series('b', THROTTLE)))
    with pytest.raises(InputError, match='several throttle series: a .*b .*--throttle'):
        choose(PATH, log)


def test_the_current_beside_the_voltage():
    """The current of the same sensor is used; another sensor's only with a single battery."""
    log = Log('x', (series('v0', group='0'), series('v1', rank=None, group='1'),
                    series('i0', CURRENT, group='0'), series('i1', CURRENT, group='1')))
    assert choose(PATH, log, voltage='v1').current.name == 'i1'
    assert choose(PATH, log).current.name == 'i0'
    assert choose(PATH, log, current='none').current is None
    assert choose(PATH, log, current='i1').current.name == 'i1'
    log = Log('x', (series('rail', rank=None), series('i', CURRENT), series('i2', CURRENT)))
    chosen = choose(PATH, log, voltage='rail')
    assert chosen.current is None
    assert any('--current' in note for note in chosen.notes)


def test_unusable_samples_are_dropped_with_a_note():
    t = [0.0, 1.0, 1.0, np.nan, 2.0, 1.5, 3.0, 1e9, 4.0, *range(5, 20)]
    mended, notes = clean(series(t=t, values=[1, 2, 3, 4, np.inf, 6, 7, 8, 9.0, *range(15)]))
    np.testing.assert_array_equal(mended.t[:5], [0.0, 1.0, 1.5, 3.0, 4.0])
    np.testing.assert_array_equal(mended.values[:5], [1, 2, 6, 7, 9])
    assert [note.split('dropped: ')[1].split(';')[0].rstrip('.') for note in notes] == [
        'not a finite number', 'the stamp is over 3600 s away from all others',
        'repeated stamp']
    assert 24 - mended.n == sum(int(note.split()[0]) for note in notes)


def test_a_sample_every_few_hours():
    t = 7200.0 * np.arange(50)
    mended, notes = clean(series(t=t, values=np.arange(50.0)))
    assert mended.n == 50 and notes == ()


def test_a_lone_wrong_stamp_costs_one_sample():
    for wrong in (0.0, 500.0):
        t = np.arange(100.0)
        t[50] = wrong
        mended, notes = clean(series(t=t, values=np.arange(100.0)))
        assert mended.n == 99 and 50.0 not in mended.values
        assert len(notes) == 1


def test_throttle_is_a_share():
    """Values beyond 0..1 are clipped, with a note if the excess is more than rounding."""
    mended, notes = clean(series('u', THROTTLE, values=(-0.001, 0.5, 1.002)))
    np.testing.assert_array_equal(mended.values, [0.0, 0.5, 1.0])
    assert notes == ()
    mended, notes = clean(series('u', THROTTLE, values=(-0.1, 0.5, 1.4)))
    np.testing.assert_array_equal(mended.values, [0.0, 0.5, 1.0])
    assert '2 values outside 0..1' in notes[0]


def test_a_voltage_without_usable_samples_is_refused():
    bad = series(values=(np.nan,) * 3)
    with pytest.raises(InputError, match='no usable sample'):
        choose(PATH, Log('x', (bad,)))
    log = Log('x', (series(), series('u', THROTTLE, values=(np.nan,) * 3)))
    chosen = choose(PATH, log)
    assert chosen.throttle is None and 'u has no usable sample.' in chosen.notes


def test_stamps_count_from_the_start():
    """The start is the log's, or an earlier sample, but not one from corrupt bytes."""
    one, two = series(t=(100.0, 101.0, 102.0)), series(t=(99.0, 101.0, 102.0))
    for given, firsts in ((99.5, [1.0, 0.0]), (90.0, [10.0, 9.0])):
        log = log_of('x', [one, two], {}, [], [], start=given)
        assert [x.t[0] for x in log.series] == firsts
    t = np.concatenate(([0.0], 1e5 + np.arange(100.0)))
    broken = series(t=t, values=t)
    assert log_of('x', [broken], {}, [], []).series[0].t[1] == 0.0
