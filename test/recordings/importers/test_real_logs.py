"""Real logs, read as a user would; their folder is not part of the project."""

import json

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.read import read_recording, read_signal
from project import needs_recordings, REAL
import pytest

pytestmark = needs_recordings
RAW = REAL / 'raw'


def test_a_blackbox_log_equals_its_published_table(tmp_path):
    """The 200 Hz table of the flight follows from its raw log of 500 Hz."""
    # The table was made by others with another parser: its stamps are smoothed, so they agree to
    # the spacing of the log (2 ms) but for a constant; its throttle is the mean of the motors.
    out = tmp_path / 'gecko'
    assert main(['convert', str(RAW / 'ie_btfl_002.bbl'), str(out)]) == 0
    table = np.loadtxt(REAL / 'bf_gecko_a.csv', delimiter=',', skiprows=1)
    back = read_recording(out)
    assert back.source['log_vehicle'] == back.source['vehicle'] == 'Gecko'
    assert back.source['voltage_field'] == 'vbatLatest'
    assert back.source['voltage_scale'] == '0.01'
    # The same readings, but for one at an end: since when the first had been there is not known.
    k = 1 if np.rint(100 * back.voltage[0]) == np.rint(100 * table[1, 1]) else 0
    table = table[k:]
    n = min(back.n, len(table))
    assert max(back.n, len(table)) - n <= 1
    table, k = table[:n], 0
    np.testing.assert_array_equal(np.rint(100 * back.voltage[:n]), np.rint(100 * table[:, 1]))
    lag = table[:, 0] - back.t[k:k + len(table)]
    assert np.abs(lag - np.median(lag)).max() < 0.0045
    held = back.throttle[k:k + len(table)]
    assert np.median(np.abs(held - table[:, 2])) < 0.002
    assert np.corrcoef(held, table[:, 2])[0, 1] > 0.999


def test_a_px4_log_with_two_batteries_converts(tmp_path, capsys):
    """The user must choose one of two batteries; it converts, and so does the 5 V rail."""
    log = str(RAW / 'px_sample_log_small.ulg')
    assert main(['convert', log, str(tmp_path / 'a')]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert 'battery_status[0].voltage_v' in said and 'battery_status[1].voltage_v' in said
    assert '--list' in said
    assert main(['convert', log, '--list', '--json', '-']) == 0
    listed = {one['name']: one for one in json.loads(capsys.readouterr().out)['series']}
    assert listed['battery_status[1].voltage_v']['n'] == 21
    assert listed['system_power[0].voltage5v_v']['default'] is False
    for name, level in (('battery_status[1].voltage_v', 49.8), ('system_power[0].voltage5v_v', 5)):
        out = tmp_path / name[:3]
        assert main(['convert', log, str(out), '--voltage', name]) == 0
        back = read_recording(out)
        assert back.source['voltage_field'] == name
        assert back.voltage.mean() == pytest.approx(level, abs=0.2)
        # The throttle keeps its own rate.
        throttle = read_signal(out, '/throttle/data').values
        assert throttle.size == 1812 and throttle.max() == pytest.approx(0.407273, abs=1e-6)


@pytest.mark.parametrize('name', ['px_sample_log_small.ulg', 'ie_btfl_002.bbl'])
def test_cut_at_random(tmp_path, capsys, name):
    """However short it is cut, a log is one line, or a bag with a note."""
    whole = (RAW / name).read_bytes()[:60_000 if name.endswith('bbl') else None]
    rng = np.random.default_rng(14)
    for k, at in enumerate(rng.integers(1, len(whole), 8).tolist()):
        path = tmp_path / f'{k}.log'
        path.write_bytes(whole[:at])
        out = tmp_path / f'{k}'
        status = main(['convert', str(path), str(out), '--voltage',
                       'vbatLatest' if name.endswith('bbl') else 'battery_status[1].voltage_v'])
        said = capsys.readouterr()
        if status == 0:
            assert 'cut off' in ' '.join(said.out.split())
            assert read_recording(out).n > 0
        else:
            assert status == 2 and said.err.count('\n') == 1 and not out.exists()


def test_broken_at_random(tmp_path):
    rng = np.random.default_rng(17)
    read = refused = 0
    for path in sorted(RAW.iterdir()):
        # The head holds what the rest is read by.
        head = path.read_bytes()[:250_000 if path.suffix == '.ulg' else 40_000]
        for _ in range(5):
            broken = bytearray(head)
            for at in rng.integers(0, 6000, rng.integers(1, 4)).tolist():
                size = int(rng.choice([1, 8, 64]))
                filling = rng.bytes(size) if rng.random() < 0.7 else b'\xff' * size
                if rng.random() < 0.3:
                    del broken[at:at + size]
                else:
                    broken[at:at + size] = filling
            log = tmp_path / f'log{path.suffix}'
            log.write_bytes(broken)
            try:
                import_log(log, Request(flight=1 if path.suffix == '.bbl' else None,
                                        everything=True))
                read += 1
            except InputError as error:
                assert '\n' not in str(error) and len(str(error)) < 1000
                refused += 1
    assert read and refused


@pytest.mark.parametrize('name, started', [
    # GPS: second 3880.6 of week 1815 less 18 leap seconds; header; GPS; a board without a clock.
    ('ac_jd_2004.bin', '2014-10-19T01:04:22'), ('bf_ar8_6s.BFL', '2022-02-02T15:04:53'),
    ('px_sample_log_small.ulg', '2021-04-21T06:30:58'), ('ie_btfl_002.bbl', '')])
def test_the_date_of_a_log_is_kept(name, started):
    """From the header or the GPS; without either there is none."""
    facts = import_log(RAW / name, Request()).facts
    assert facts.get('started', '').startswith(started) and bool(started) == ('started' in facts)
