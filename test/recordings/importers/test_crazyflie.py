"""Logs of a Crazyflie's micro-SD deck, written by the firmware's own rules."""

from made_logs import crazyflie, FIXED, hover, load
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.log import IMU
from ou_monitor.recordings.read import read_beside, read_recording
import pytest


@pytest.mark.parametrize('version, unit', [(1, 1e-3), (2, 1e-6)])
def test_values_and_stamps(tmp_path, version, unit):
    """Every variable of every event, in SI; stamps of version 1 in ms, of version 2 in us."""
    events, records, table = hover()
    path, log = load(tmp_path, crazyflie(events, records, version))
    assert log.format == 'crazyflie' and log.notes == ()
    found = {one.name: one for one in log.series}
    np.testing.assert_allclose(found['pm.vbat'].t, 2000 * unit * np.arange(300), atol=1e-9)
    np.testing.assert_array_equal(found['pm.vbat'].values, table[:, 0])
    np.testing.assert_allclose(found['motors'].values, table[:, 1:5].mean(axis=1) / 65535)
    np.testing.assert_array_equal(found['pm.state'].values, table[:, 11])
    np.testing.assert_array_equal(found['estTDOA.id'].values, np.arange(0, 300, 7))
    np.testing.assert_allclose(found['estTDOA.x'].t,
                               unit * (900 + 2000 * np.arange(0, 300, 7)), atol=1e-9)
    gyro, = log.of(IMU)
    np.testing.assert_allclose(gyro.values[:, :3], np.radians(table[:, 5:8]))
    np.testing.assert_allclose(gyro.values[:, 3:], 9.80665 * table[:, 8:11])
    assert (found['gyro.x'].unit, found['acc.z'].unit, found['pm.state'].unit) == (
        'rad/s', 'm/s^2', '?')


def test_a_crazyflie_log_is_read_and_converted(tmp_path):
    events, records, table = hover(3000, refresh=5)
    path, _ = load(tmp_path, crazyflie(events, records))
    assert main(['convert', str(path), str(tmp_path / 'bag')]) == 0
    log, bag = read_recording(path), read_recording(tmp_path / 'bag')
    assert log.source['voltage'] == 'pm.vbat' and log.source['throttle'] == 'motors'
    assert 598 <= log.n <= 600 and np.median(np.diff(log.t)) == pytest.approx(0.01)
    np.testing.assert_array_equal(log.t, bag.t)
    np.testing.assert_array_equal(log.voltage, bag.voltage)
    np.testing.assert_array_equal(log.throttle, bag.throttle)
    _, gyro = read_beside(path, 'gyro.z')
    np.testing.assert_allclose(gyro.values, np.radians(table[:, 7]))


@pytest.mark.parametrize('cut', [1, 4, 30, 3001])
def test_a_log_that_was_cut_off(tmp_path, cut):
    """All complete records are read, and a note says that the checksum is missing."""
    events, records, table = hover()
    content = b''.join(crazyflie(events, records))
    path, log = load(tmp_path, [content[:-cut]])
    found = {one.name: one for one in log.series}['pm.vbat']
    assert 0 < found.n <= 300
    np.testing.assert_array_equal(found.values, table[:found.n, 0])
    assert any('checksum does not match' in note for note in log.notes)


def test_wrong_bytes_are_reported(tmp_path):
    """A bit in a value breaks the checksum; an unknown event ends the reading, with its byte."""
    events, records, _ = hover()
    pieces = crazyflie(events, records)
    content = bytearray(b''.join(pieces))
    begin = len(pieces[0])
    content[begin + 12] ^= 1
    _, log = load(tmp_path, [bytes(content)])
    assert any('checksum does not match' in note for note in log.notes)
    at = sum(map(len, pieces[:101]))
    content[at] ^= 1
    _, log = load(tmp_path, [bytes(content)])
    assert any(f'from byte {at} on were not read' in note for note in log.notes)
    assert sum(one.n for one in log.series if one.name.endswith('vbat')) == 100


@pytest.mark.parametrize('events, words', [
    ([(FIXED, 'fixedFrequency', ['pm.vbat(f)']), (FIXED, 'a', ['b(f)'])], 'two events 65535'),
    ([(FIXED, 'fixedFrequency', ['pm.vbat(z)'])], "no type for 'pm.vbat.z.'")])
def test_senseless_header_is_refused(tmp_path, events, words):
    with pytest.raises(InputError, match=words):
        load(tmp_path, crazyflie(events, []))
    content = b''.join(crazyflie([(1, 'a', ['pm.vbat(f)'])], []))
    for end in (6, 9, 12, 20):
        with pytest.raises(InputError, match='header does not end'):
            load(tmp_path, [content[:end]])


def test_without_a_voltage(tmp_path):
    """The line that names what could be taken names the format too."""
    path, _ = load(tmp_path, crazyflie([(1, 'a', ['pm.vbat(f)'])], [(1, 5, (3.7,))]))
    with pytest.raises(InputError, match='has no battery voltage.*a.pm.vbat'):
        read_recording(path)
