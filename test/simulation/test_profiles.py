"""Throttle over time: names, numbers, points, CSV; one line for anything else."""

import os
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.simulation import (
    constant, is_recording, plan, PROFILES, read_profile, through)
import pytest


def at(profile, *times):
    """Return throttle at some times, s."""
    return profile(np.array(times, dtype=float)).tolist()


def refused(text):
    """Return the one line of a profile that must be refused."""
    with pytest.raises(InputError) as caught:
        read_profile(text)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('rate', [1000.0, 50.0, 333.0, 20_000.0])
def test_steps_are_at_their_stamps(rate):
    """At the stamp of a step throttle is the new one, one sample before the old; also repeated."""
    loads = read_profile('loads')
    for period in (0.0, 40.0, 4000.0):
        for time, old, new in ((10.0, 0.0, 0.05), (20.0, 0.05, 0.1), (30.0, 0.1, 0.4),
                               (40.0, 0.4, 0.0)):
            k = round((period + time) * rate)
            assert at(loads, (k - 1) / rate, k / rate) == pytest.approx([old, new], abs=0)


def test_the_transient_of_the_paper():
    """0 -> 20 -> 0 %, 3 s each way in 10 s, repeated."""
    assert at(read_profile('transient'), 0.0, 2.999, 3.0, 5.999, 6.0, 9.999, 13.0, 16.0) == [
        0.0, 0.0, 0.2, 0.2, 0.0, 0.0, 0.2, 0.0]


@pytest.mark.parametrize('name', sorted(PROFILES))
def test_named_profiles_stay_within_0_and_1(name):
    """Defined at all times, and equal from one array or sample by sample."""
    assert set(PROFILES) == {'flight', 'hover', 'loads', 'transient'}
    profile = read_profile(name)
    t = np.arange(0.0, 100.0, 0.013)
    whole = profile(t)
    assert whole.shape == t.shape and whole.min() >= 0.0 and whole.max() <= 1.0
    assert np.ptp(whole) > 0.05
    np.testing.assert_array_equal(np.concatenate([profile(t[k:k + 1]) for k in range(t.size)]),
                                  whole)
    assert PROFILES[name][1]


@pytest.mark.parametrize('name', ['flight', 'hover'])
def test_the_stick_moves_fifty_times_a_second(name):
    """Values change at multiples of 20 ms alone."""
    t = np.arange(40_000) / 1000.0
    changes = np.flatnonzero(np.diff(read_profile(name)(t))) + 1
    assert changes.size > 100 and np.all(changes % 20 == 0)


def test_the_flight_profile_repeats_every_40_s():
    t = np.arange(0.0, 40.0, 0.02)
    flight = read_profile('flight')
    np.testing.assert_allclose(flight(t + 80.0), flight(t), rtol=0, atol=1e-9)
    assert at(flight, 3.0, 10.0, 27.0) == pytest.approx([0.05, 0.40, 0.75])


@pytest.mark.parametrize('text, value', [('0', 0.0), ('1', 1.0), ('0.4', 0.4), ('4e-1', 0.4),
                                         (' 0.25 ', 0.25)])
def test_a_number_is_a_constant_profile(text, value):
    assert at(read_profile(text), -1.0, 0.0, 1e9) == [value] * 3
    assert at(constant(value), 0.0) == [value]


def test_points_are_joined_by_straight_lines():
    """Constant beyond the last one; two points at one time are a step."""
    assert at(read_profile('1:0.2,3:0.6,3:0.1,5:0.1'), 0.0, 1.0, 2.0, 2.5, 3.0, 4.0, 99.0) == (
        pytest.approx([0.2, 0.2, 0.4, 0.5, 0.1, 0.1, 0.1]))
    assert at(read_profile('2:0.3'), 0.0, 2.0, 9.0) == [0.3] * 3
    assert at(read_profile('0:0,1:0,1:1'), 0.999, 1.0, 5.0) == [0.0, 1.0, 1.0]


def test_profiles_repeat_and_hold_their_values():
    """A period wraps; a held profile keeps the value of the last update."""
    ramp = through([(0.0, 0.0), (1.0, 1.0)], period=1.0, stick_rate=10.0)
    assert at(ramp, 0.0, 0.05, 0.1, 0.15, 0.9, 1.0, 1.25) == pytest.approx(
        [0.0, 0.0, 0.1, 0.1, 0.9, 0.0, 0.2])


def test_a_csv_is_a_profile(tmp_path):
    """Columns by name in any order; others are ignored."""
    path = tmp_path / 'stick.CSV'
    path.write_text('throttle,x,time_s\n0.0,9,0\n0.5,9,1\n0.5,9,2\n0.1,9,2\n')
    assert at(read_profile(str(path)), 0.0, 0.5, 1.5, 2.0, 50.0) == pytest.approx(
        [0.0, 0.25, 0.5, 0.1, 0.1])
    path.write_text('t_ms;gas_percent\n0;0,0\n1000;50,0\n', encoding='utf-8')
    assert at(read_profile(str(path)), 0.5, 2.0) == pytest.approx([0.25, 0.5])
    named = CsvColumns(time='t_ms', throttle='x', throttle_unit='%')
    path.write_text('t_ms;x\n0;0,0\n1000;50,0\n', encoding='utf-8')
    assert at(read_profile(str(path), named), 0.5, 2.0) == pytest.approx([0.25, 0.5])
    one = tmp_path / 'one.csv'
    one.write_text('time_s,throttle\n0,0.7\n')
    assert at(read_profile(str(one)), 0.0, 10.0) == [0.7, 0.7]


def test_points_set_the_length(tmp_path):
    path = tmp_path / 'stick.csv'
    path.write_text('time_s,throttle\n0,0.1\n5,0.45\n90,0.45\n')
    assert [plan(throttle=text).duration for text in (str(path), '0:0.1,30:0.5', '0.4', 'flight')
            ] == [90.0, 30.0, 120.0, 120.0]


@pytest.mark.parametrize('text, words', [
    ('fligth', ["'fligth'", "'flight'", '0..1', 'CSV']), ('', ["''"]), ('xyz', ["'xyz'"]),
    ('1.1', ['0..1', '1.1']), ('-0.1', ['0..1', '-0.1']), ('nan', ['0..1']), ('inf', ['0..1']),
    ('40%', ["'40%'"]), ('0:0,1', ["'1'", 'T:U']), ('0:0,', ["''", 'T:U']),
    ('0:0:0', ["'0:0:0'", 'T:U']), ('a:0', ["'a:0'"]), ('0:b', ["'0:b'"]),
    ('0:0,1:2', ['0..1', 'got 2']), ('1:0,0:0', ['not fall', '0 s comes after 1 s']),
    ('0:nan,1:0', ['0..1']), ('nan:0.5', ['finite']), ('0:0,inf:0', ['finite']),
    ('0:0,nan:0', ['fall']), ('0:0,1_0:0', ["'1_0:0'"]), ('\u0660', ['valid: flight']),
])
def test_a_wrong_profile_is_named_in_one_line(text, words):
    line = refused(text)
    assert all(word in line for word in words), line


@pytest.mark.parametrize('content, words', [
    (b'', 'empty'), (b'\n\n', 'empty'), (b'time_s,throttle\n', 'no row'),
    (b'time_s,x\n0,0\n', 'valid: time_s, x (--throttle-column)'),
    (b'0,0.1,5\n1,0.2,3\n', "no column 'throttle'"),
    (b'time_s,throttle\n0,0.1\n1,x\n', 'throttle must be a number 0..1'),
    (b'time_s,throttle\n0,0.1\nx,0.1\n', 'times'),
    (b'time_s,throttle\n0,0.1\n1,400\n', 'got 400'),
    (b'time_s,throttle\n1,0.1\n0,0.1\n', 'must not fall'),
    (b'time_s,throttle\n0,0.1\n1,1_0\n', ":3: column 'throttle' holds '1_0'"),
    (b'time_s,throttle\n0,0.1\n1,0.1,5\n', ':3: 3 cells'),
    (b'\xff\xfe\x00time', "no column 'time_s'"), (b'# nothing\n', 'stick.csv'),
    (None, 'cannot read'),
])
def test_a_wrong_profile_csv_is_named_in_one_line(tmp_path, content, words):
    """Also a missing file, an empty one, and bytes."""
    path = tmp_path / 'stick.csv'
    if content is not None:
        path.write_bytes(content)
    line = refused(str(path))
    assert str(path) in line and words in line, line


@pytest.mark.parametrize('make', [Path.mkdir, os.mkfifo])
def test_a_profile_is_a_regular_file(tmp_path, make):
    """No folder, and no FIFO, which would wait for its writer."""
    path = tmp_path / 'a.csv'
    make(path)
    assert not is_recording(str(path))
    assert f'cannot read {path}: ' in refused(str(path))
