"""`ou-monitor convert`: a CSV becomes a bag."""

import json
import os
from pathlib import Path

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.recordings.read import read_recording, read_signal
import pytest

GOOD = 'time_s,voltage_v,throttle\n0.5,5.0,0.1\n0.6,5.1,0.1\n0.6,5.2,0.2\n0.7,5.3,0.3\n'


@pytest.fixture
def log(tmp_path):
    path = tmp_path / 'log.csv'
    path.write_text(GOOD)
    return path


@pytest.mark.parametrize('name', ['out', 'out.mcap'])
def test_a_converted_log_reads_back(log, tmp_path, capsys, name):
    """The bag reads back, and repairs are reported."""
    out = tmp_path / name
    assert main(['convert', str(log), str(out)]) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert '3 samples' in text and '- voltage_v, throttle: 1 sample dropped' in text
    back = read_recording(out)
    np.testing.assert_allclose(back.t, [0.5, 0.6, 0.7], rtol=0, atol=1e-9)
    np.testing.assert_allclose(back.voltage, [5.0, 5.1, 5.3], rtol=1e-7)
    np.testing.assert_allclose(back.throttle, [0.1, 0.1, 0.3], rtol=1e-7)


def test_json_goes_to_standard_output_or_a_file(log, tmp_path, capsys):
    assert main(['convert', str(log), str(tmp_path / 'a'), '--json', '-']) == 0
    content = json.loads(capsys.readouterr().out)
    assert content['n'] == 3
    assert content['topics'] == {'/voltage': 'sensor_msgs/msg/BatteryState',
                                 '/throttle': 'std_msgs/msg/Float32'}
    assert content['duration_s'] == pytest.approx(0.2)
    assert len(content['notes']) == 1
    target = tmp_path / 'b.json'
    assert main(['convert', str(log), str(tmp_path / 'b'), '--json', str(target)]) == 0
    assert json.loads(target.read_text())['out'] == str(tmp_path / 'b')


@pytest.mark.parametrize('log_text, arguments, words', [
    (None, ['no.csv', 'out'], ["no log 'no.csv'"]),
    (GOOD, ['log.csv', 'log.csv'], ['.mcap', 'folder']),
    (GOOD, ['log.csv', 'there'], ['exists already']),
    (GOOD, ['log.csv', 'no/out'], ['does not exist']),
    (GOOD, ['log.csv', '/sys/out.mcap'], ['cannot write']),
    (GOOD, ['log.csv', 'out', '--json', 'no/x.json'], ['no/x.json']),
    ('when,voltage_v\n0,5\n', ['log.csv', 'out'], ["'time_s'"]),
    ('', ['log.csv', 'out'], ['empty']),
    ('', ['log.ulg', 'out'], ["'log.ulg' is empty"]),
    ('\0\1\2', ['log', 'out'], ['ULog', 'dataflash', 'blackbox', 'CSV', 'can be read']),
    (GOOD, ['log.csv'], ['required: OUT']),
    (GOOD, ['log.csv', 'out', '--list'], ['--list writes no bag']),
    (GOOD, ['log.csv', '--list', 'out'], ['--list writes no bag']),
    (GOOD, ['log.csv', 'out', '--flight', '2'], ['holds one flight']),
    (GOOD, ['log.csv', 'out', '--flight', '0'], ["'0'"]),
    (GOOD, ['log.csv', 'out', '--voltage', 'volts'], ["no voltage 'volts'", 'voltage_v']),
    (GOOD, ['log.csv', 'out', '--voltage', 'throttle'], ['is a throttle']),
    ('time_s,volts\n0,5\n1,5\n', ['log.csv', 'out', '--list', 'x'], ['further argument']),
    ('time_s,voltage_v\n', ['log.csv', 'out'], ['no line below']),
    ('time_s,voltage_v\n1.7e12,5\n1.8e12,5\n', ['log.csv', 'out'],
     ["1e+11 s apart by 'time_s'", 'in ms']),
    ('time_s,voltage_v,throttle\n0,5,400\n1,5,500\n', ['log.csv', 'out'],
     ['throttle runs from 400 to 500', '--throttle-unit LOW:HIGH']),
    ('time_s,bus\n0,5\n1,5\n', ['log.csv', 'out'], ["no column 'voltage_v'", '--voltage']),
])
def test_bad_input_exits_with_2(tmp_path, monkeypatch, capsys, log_text, arguments, words):
    """Exit status 2, one line on standard error, no bag."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'there').mkdir()
    if log_text is not None:
        (tmp_path / arguments[0]).write_text(log_text)
    try:
        status = main(['convert', *arguments])
    except SystemExit as end:
        status = end.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ''
    assert captured.err.count('\n') == 1
    for word in words:
        assert word in captured.err
    assert not (tmp_path / 'out').exists()


def test_file_name_of_invalid_text(tmp_path, capsys):
    path = os.path.join(os.fsencode(tmp_path), b'\xff.csv')
    Path(os.fsdecode(path)).write_text(GOOD)
    for out in ('out', 'out.mcap', os.fsdecode(b'\xfe'), os.fsdecode(b'\xfe.mcap')):
        assert main(['convert', os.fsdecode(path), str(tmp_path / out), '--json', '-']) == 0
        assert json.loads(capsys.readouterr().out)['log'] == os.fsdecode(path)
        source = read_recording(tmp_path / out).source
        assert source['log_file'] == '\\udcff.csv'


def test_columns_of_a_csv(tmp_path, capsys):
    path = tmp_path / 'a.csv'
    path.write_text('time_s,bus,duty,amps,word\n0,5.0,0.1,2,x\n1,5.1,0.2,3,y\n2,5.2,0.3,4,z\n')
    assert main(['convert', str(path), '--list']) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert all(word in text for word in ('bus', 'duty', 'amps', "'word' does not hold numbers"))
    assert main(['convert', str(path), '--voltage', 'bus', str(tmp_path / 'b'), '--throttle',
                 'duty', '--current', 'amps']) == 0
    back = read_recording(tmp_path / 'b')
    np.testing.assert_allclose(back.voltage, [5.0, 5.1, 5.2], rtol=1e-7)
    np.testing.assert_allclose(back.throttle, [0.1, 0.2, 0.3], rtol=1e-7)
    assert back.source['voltage_field'] == 'bus'
    np.testing.assert_allclose(read_signal(tmp_path / 'b', '/current/data').values, [2, 3, 4])
