"""The throttle of a recording as a profile: a CSV, a bag, a part of one."""

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.read import read_recording
from ou_monitor.simulation import is_recording, read_throttle
import pytest

ROWS = '1000,12.0,0.1\n1001,12.0,0.1\n1002,11.5,0.6\n1003,11.4,0.2\n1004,11.9,0.2\n'


@pytest.fixture
def flight(tmp_path):
    """Return a CSV of five seconds that begin at 1000 s."""
    path = tmp_path / 'flight.csv'
    path.write_text('time_s,voltage_v,throttle\n' + ROWS, encoding='utf-8')
    return path


def test_each_value_holds_until_the_next(flight):
    """Stamps count from the begin of the part, and the last value stays."""
    whole = read_throttle(str(flight))
    assert whole.duration == 4.0
    at = np.array([0.0, 1.5, 2.0, 2.999, 3.0, 99.0])
    np.testing.assert_allclose(whole.profile(at), [0.1, 0.1, 0.6, 0.6, 0.2, 0.2])
    part = read_throttle(str(flight), 2.0, 4.0)
    assert part.duration == 1.0
    np.testing.assert_allclose(part.profile(np.array([0.0, 1.0])), [0.6, 0.2])


def test_what_is_a_recording(flight, tmp_path):
    """A CSV with voltage is one; one of throttle alone is a profile; so is a profile's name."""
    stick = tmp_path / 'stick.csv'
    stick.write_text('time_s,throttle\n0,0.1\n', encoding='utf-8')
    assert is_recording(str(flight)) and is_recording(str(tmp_path))
    assert not any(is_recording(text) for text in (
        str(stick), 'flight', '0.4', 'nowhere.mcap', str(tmp_path / 'no.csv')))


def test_a_simulation_over_a_recording(flight, tmp_path, capsys):
    """Its length is the default; --from and --to take a part; a bag does as well as a CSV."""
    first, again = tmp_path / 'first.mcap', tmp_path / 'again.mcap'
    assert main(['simulate', '--throttle', str(flight), '--rate', '100', '--output',
                 str(first)]) == 0
    one = read_recording(first)
    assert one.n == 400
    np.testing.assert_allclose(one.throttle[[0, 199, 200, 300]], [0.1, 0.1, 0.6, 0.2], atol=1e-6)
    assert main(['simulate', '--throttle', str(first), '--from', '1', '--to', '3', '--rate',
                 '100', '--output', str(again)]) == 0
    two = read_recording(again)
    assert two.n == pytest.approx(200, abs=1)
    np.testing.assert_allclose(two.throttle[[50, 150]], [0.1, 0.6], atol=1e-6)
    # Words, because a long path wraps the line.
    assert '4 s at 100 Hz' in ' '.join(capsys.readouterr().out.split())


def test_throttle_of_an_unusable_recording_is_refused(flight, tmp_path, capsys):
    """No throttle, throttle in percent, a part outside the recording: one line each."""
    none = tmp_path / 'none.csv'
    none.write_text('time_s,voltage_v\n0,5\n1,5\n', encoding='utf-8')
    with pytest.raises(InputError, match='has no throttle'):
        read_throttle(str(none))
    percent = tmp_path / 'percent.csv'
    percent.write_text(
        'time_s,voltage_v,throttle\n0,5,400\n1,5,870\n', encoding='utf-8')
    with pytest.raises(InputError, match='throttle runs from 400 to 870'):
        read_throttle(str(percent))
    assert main(['simulate', '--throttle', 'flight', '--from', '1', '--output',
                 str(tmp_path / 'x.mcap')]) == 2
    assert 'give --throttle RECORDING' in capsys.readouterr().err
    assert main(['simulate', '--throttle', str(flight), '--output', str(flight)]) == 2
