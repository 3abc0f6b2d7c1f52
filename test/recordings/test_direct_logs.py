"""Logs and any CSV are read directly, with the same result as after `convert`."""

import json

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose, columns_of
from ou_monitor.recordings.importers.csv_table import CsvColumns
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.read import read_recording
from project import needs_recordings, REAL
import pytest


@needs_recordings
@pytest.mark.parametrize('file,package,voltage', [
    ('ac_erle_althold2.BIN', 'pymavlink', None),
    ('px_sample_log_small.ulg', 'pyulog', 'battery_status[1].voltage_v')])
def test_a_log_equals_its_converted_bag(file, package, voltage, tmp_path):
    pytest.importorskip(package)
    log = REAL / 'raw' / file
    assert main(['convert', str(log), str(tmp_path / 'bag'),
                 *(() if voltage is None else ('--voltage', voltage))]) == 0
    columns = None if voltage is None else CsvColumns(voltage=voltage)
    wanted = read_recording(tmp_path / 'bag')
    found = read_recording(log, columns=columns)
    np.testing.assert_array_equal(found.t, wanted.t)
    np.testing.assert_array_equal(found.voltage, wanted.voltage)
    np.testing.assert_array_equal(found.throttle, wanted.throttle)
    assert found.name == file and found.source['format'] in ('dataflash', 'ulog')
    part = read_recording(log, start=1.0, end=2.0, columns=columns)
    assert 0 < part.n < found.n and part.duration < 1.0


@needs_recordings
@pytest.mark.parametrize('file,rate', [('in_xr_141340.TXT', 49.47), ('ie_btfl_002.bbl', 199.1)])
def test_one_flight_as_log_csv_and_bag_is_one_recording(file, rate, tmp_path):
    pytest.importorskip('orangebox')
    path = tmp_path / file
    # Seconds are enough: the reader of blackbox logs takes one for each 300 kB.
    path.write_bytes((REAL / 'raw' / file).read_bytes()[:500_000])
    log = import_log(path, Request())
    raw = columns_of(path, log, choose(path, log))
    sheet, bag = tmp_path / 'flight.csv', tmp_path / 'flight.mcap'
    sheet.write_text('time_s,voltage_v,throttle,current_a\n' + ''.join(
        '{!r},{!r},{!r},{!r}\n'.format(*line) for line in np.stack(
            [raw.t, raw.voltage, raw.throttle, raw.current], axis=1).tolist()))
    assert main(['convert', str(path), str(bag)]) == 0
    wanted = read_recording(path)
    assert wanted.held > 0 and wanted.n + wanted.held == raw.t.size
    for one in (sheet, bag):
        found = read_recording(one)
        assert found.held == wanted.held
        # One reading more or less of 315.
        assert (found.n - 1) / found.duration == pytest.approx(rate, rel=1.0 / 315)
        for name in ('t', 'voltage', 'throttle', 'current'):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    if wanted.n > 5000:
        return
    answers = []
    for one in (path, sheet, bag):
        # Only a log states cells and a limit of its own.
        assert main(['analyze', str(one), '--cells', '4', '--brownout-voltage', '2.5', '--json',
                     str(tmp_path / 'out.json'), '--force']) == 0
        answers.append(json.loads((tmp_path / 'out.json').read_text()))
        # How the file was read differs (`quality` holds the notes on that too), nothing else.
        for name in ('recording', 'source', 'notes', 'quality'):
            del answers[-1][name]
    assert answers[0] == answers[1] == answers[2]
    assert 'sag' in json.dumps(answers[0])


@needs_recordings
def test_repeats_in_a_csv_do_not_raise_its_rate():
    """A Crazyflie logged at 500 Hz reads its battery at 100 Hz."""
    found = read_recording(REAL / 'cf_bl00.csv')
    assert found.n == 924 and found.held == 3710
    assert (found.n - 1) / found.duration == pytest.approx(100.0, rel=0.02)


def test_columns_and_units_of_a_csv(tmp_path):
    path = tmp_path / 'own.csv'
    path.write_text('when,mv,stick,throttle\n0,5000,0.25,9\n20,4900,0.5,9\n40,4950,0.75,9\n')
    found = read_recording(path, columns=CsvColumns('when', 'mv', 'stick', 'mV', 'ms'))
    np.testing.assert_allclose(found.t, [0.0, 0.02, 0.04])
    np.testing.assert_allclose(found.voltage, [5.0, 4.9, 4.95])
    np.testing.assert_allclose(found.throttle, [0.25, 0.5, 0.75])


@pytest.mark.parametrize('options,words', [
    (['--flight', '2'], 'is a CSV: --flight is for logs'),
    (['--unit', 'kV'], 'invalid choice'),
    (['--voltage-column', 'volts'], "no column 'volts'")])
def test_options_that_do_not_fit_are_refused(options, words, tmp_path, capsys):
    path = tmp_path / 'a.csv'
    path.write_text('time_s,voltage_v\n0,5\n1,5\n')
    try:
        status = main(['analyze', str(path), *options])
    except SystemExit as stop:
        status = stop.code
    assert status == 2 and words in capsys.readouterr().err


def test_suspicious_units_and_columns_are_noted(tmp_path):
    path = tmp_path / 'odd.csv'
    path.write_text('time_s,voltage_v,throttle\n0,0.1,16.1\n1,0.2,16.0\n2,0.2,15.9\n')
    with pytest.raises(InputError, match='are the two columns swapped'):
        read_recording(path)
    path.write_text('time_s,voltage_v\n0,16.1\n20,16.0\n40,15.9\n')
    assert any('20 s apart' in note and '--time-unit' in note
               for note in read_recording(path).notes)
    with pytest.raises(InputError, match="fleet' takes folders"):
        read_recording(tmp_path)
