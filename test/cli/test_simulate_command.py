"""`ou-monitor simulate` for users: bags, presets, models, seeds, bad options, Ctrl-C."""

import json
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from command_line import answer, failure
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.simulation import PRESETS
import pytest

ROOT = Path(__file__).resolve().parents[2]
MODEL = """model:
- term: ou
  params: {alpha: 40.0, sigma: 0.5, u0: 12.0}
- term: load_sag
  params: {linear: 1.0, square: 0.0}
"""


def simulate(*argv):
    """Run the command; it must succeed."""
    assert main(['simulate', *(str(word) for word in argv)]) == 0


@pytest.mark.parametrize('name', ['a.mcap', 'folder'])
def test_the_simulated_bag_can_be_analyzed(tmp_path, name, capsys):
    """One file, or a rosbag2 folder: stamps, throttle, and the law of the preset."""
    path = tmp_path / name
    simulate('--preset', 'load_40', '--duration', 20, '--output', path)
    assert path.is_dir() == (name == 'folder')
    assert sorted(p.name for p in tmp_path.rglob('*') if p.is_file()) == (
        ['folder_0.mcap', 'metadata.yaml'] if name == 'folder' else ['a.mcap'])
    out, err = capsys.readouterr()
    assert err == ''
    said = ' '.join(out.split())
    assert all(word in said for word in (str(path), '20000 samples', "'load_40'", 'seed 1'))
    rec = read_recording(path)
    np.testing.assert_allclose(rec.t, np.arange(20_000) / 1000.0, rtol=0, atol=1.1e-9)
    assert np.all(rec.throttle == np.float32(0.4)) and rec.notes == ()
    # sqrt(2/(alpha T)) = 4 % of the variance.
    assert abs(np.var(rec.voltage) / 3.17e-3 - 1.0) < 4.0 * math.sqrt(2.0 / 1260.0)
    (level,) = answer(capsys, 'analyze', path)['levels']
    # 20 000 innovations: sigma to 0.5 %, 0.7 % with alpha unknown.
    assert abs(level['sigma'] / 0.632 - 1.0) < 4.0 * 0.007


def test_json_has_the_parameters_of_every_term(tmp_path, capsys):
    target = tmp_path / 'a.json'
    simulate('--preset', 'load_10', '--duration', 2, '--rate', 500, '--seed', 7, '--throttle',
             '0.3', '--output', tmp_path / 'a.mcap', '--json', target)
    assert json.loads(target.read_text()) == {
        'output': str(tmp_path / 'a.mcap'), 'duration_s': 2.0, 'rate_hz': 500.0, 'seed': 7,
        'throttle': '0.3', 'n': 1000, 'topics': {'/voltage': 'sensor_msgs/msg/BatteryState',
                                                 '/throttle': 'std_msgs/msg/Float32'},
        'model': [{'term': 'ou', 'params': {'alpha': 63.0, 'sigma': 0.3156, 'u0': 5.0}}]}
    assert 'a.mcap' in capsys.readouterr().out


@pytest.mark.parametrize('name', ['a', 'a.mcap'])
def test_the_same_seed_gives_the_same_bytes(tmp_path, name):
    """All files of a bag, byte for byte; another seed, other samples."""
    files = []
    for folder, seed in (('one', 3), ('two', 3), ('three', 4)):
        (tmp_path / folder).mkdir()
        simulate('--preset', 'flight_full', '--duration', 3, '--seed', seed, '--output',
                 tmp_path / folder / name)
        files.append({p.name: p.read_bytes() for p in (tmp_path / folder).rglob('*')
                      if p.is_file()})
    assert files[0] == files[1] != files[2]
    assert set(files[0]) == set(files[2])


def test_a_saved_model_gives_the_same_samples(tmp_path):
    for preset in ('flight_full', 'transient'):
        saved = tmp_path / f'{preset}.yaml'
        simulate('--preset', preset, '--duration', 8, '--seed', 5, '--output',
                 tmp_path / f'{preset}.mcap', '--save-model', saved)
        file = read_model(saved)
        assert file.model == PRESETS[preset].model and file.provenance == {'preset': preset}
        simulate('--model', saved, '--duration', 8, '--seed', 5, '--throttle',
                 PRESETS[preset].throttle, '--output', tmp_path / f'{preset}_2.mcap')
        one, two = (read_recording(tmp_path / f'{preset}{end}.mcap') for end in ('', '_2'))
        np.testing.assert_array_equal(one.voltage, two.voltage)
        np.testing.assert_array_equal(one.throttle, two.throttle)


def test_a_model_can_be_saved_without_a_recording(tmp_path, capsys):
    simulate('--preset', 'loads', '--save-model', tmp_path / 'm.yaml')
    assert read_model(tmp_path / 'm.yaml').model == PRESETS['loads'].model
    assert [p.name for p in tmp_path.iterdir()] == ['m.yaml']
    assert capsys.readouterr().err == ''


def test_a_model_file_is_simulated_as_written(tmp_path):
    """Mean, sag and variance are those of the file; throttle by points."""
    (tmp_path / 'own.yaml').write_text(MODEL)
    simulate('--model', tmp_path / 'own.yaml', '--duration', 40, '--throttle', '0:0,20:0,20:0.5',
             '--output', tmp_path / 'a.mcap', '--type', 'float64')
    rec = read_recording(tmp_path / 'a.mcap')
    std = 0.5 / math.sqrt(80.0)
    for half, level in ((rec.voltage[:20_000], 12.0), (rec.voltage[20_000:], 11.5)):
        # A mean over T = 20 s, 800 relaxations.
        assert abs(half.mean() - level) < 4.0 * std * math.sqrt(2.0 / 800.0)
        assert abs(half.var() / std ** 2 - 1.0) < 4.0 * math.sqrt(2.0 / 800.0)
    assert rec.throttle[19_999] == 0.0 and rec.throttle[20_000] == 0.5


@pytest.mark.parametrize('rate, duration', [(20_000, 2.0), (1_000_000, 0.1), (44_100, 0.50003)])
def test_blocks_say_their_own_rate(tmp_path, rate, duration):
    """From 5 kHz on samples travel in blocks, and read back at their rate, to the last one."""
    path = tmp_path / 'a.mcap'
    simulate('--preset', 'load_40', '--duration', duration, '--rate', rate, '--output', path)
    reader = BagReader(path)
    assert reader.topics['/voltage'] == 'std_msgs/msg/Float32MultiArray'
    assert reader.sample_rates == {'/voltage': float(rate)}
    rec = read_recording(path)
    n = round(rate * duration)
    assert rec.n == n
    # Stamps of blocks are whole ns.
    np.testing.assert_allclose(rec.t, np.arange(n) / rate, rtol=0, atol=2e-9)
    steps = np.diff(rec.voltage)
    # Var of a step is sigma^2 dt: to sqrt(2/n).
    assert abs(steps.var() / (0.632 ** 2 / rate) - 1.0) < 4.0 * math.sqrt(2.0 / n) + 63.0 / rate


def test_throttle_changes_within_a_block(tmp_path):
    path = tmp_path / 'a.mcap'
    simulate('--preset', 'loads', '--duration', 0.1, '--rate', 20_000, '--throttle',
             '0:0.1,0.05125:0.1,0.05125:0.4', '--output', path)
    throttle = read_recording(path).throttle
    np.testing.assert_array_equal(
        throttle, np.where(np.arange(2000) < 1025, np.float32(0.1), np.float32(0.4)))


@pytest.mark.parametrize('options, words', [
    (['--preset', 'lod_10'], "'load_10'"), (['--preset', ''], "''"),
    (['--duration', '0'], '--duration'), (['--duration', '-1'], '--duration'),
    (['--duration', 'nan'], '--duration'), (['--duration', 'inf'], '--duration'),
    (['--duration', 'x'], '--duration'), (['--duration', '1_0'], '--duration'),
    (['--rate', '0'], '--rate'),
    (['--rate', 'nan'], '--rate'), (['--rate', '-5'], '--rate'),
    (['--rate', '1e-3', '--duration', '10'], '0.01 samples'),
    (['--rate', '1e9', '--duration', '1e9'], '1e+18 samples'),
    (['--rate', '2e9', '--duration', '1e-6'], '--rate must be at most 1e+09 Hz'),
    (['--rate', '1e10', '--duration', '1e-6', '--type', 'float32'], '--rate'),
    (['--rate', '1e-7', '--duration', '1e11', '--type', 'float64'], '--duration must be at most'),
    (['--scale-resistance', '-1'], '--scale-resistance'),
    (['--scale-resistance', 'nan'], '--scale-resistance'),
    (['--seed', '-1'], '--seed'), (['--seed', '1.5'], '--seed'), (['--throttle', '2'], '0..1'),
    (['--throttle', 'flihgt'], "'flight'"), (['--throttle', 'none.csv'], 'none.csv'),
    (['--type', 'float16'], 'float16'), (['--model', 'none.yaml'], 'none.yaml'),
    (['--preset', 'idle', '--model', 'm.yaml'], '--preset'), (['--sed', '1'], '--seed'),
    (['extra'], 'extra'), (['--json', '/nowhere/a.json'], '/nowhere'),
    (['--save-model', '/nowhere/m.yaml'], '/nowhere'), (['--save-model', '/'], 'folder'),
])
def test_bad_options_leave_nothing(tmp_path, options, words, capsys):
    """One line with the option or the value, status 2, and no file."""
    assert words in failure(capsys, 'simulate', '--output', tmp_path / 'a.mcap', *options)
    assert list(tmp_path.iterdir()) == []


def test_output_is_needed(tmp_path, monkeypatch, capsys):
    """Without it there is nowhere to go, nor anything to tell."""
    monkeypatch.chdir(tmp_path)
    assert '--output' in failure(capsys, 'simulate', '--preset', 'idle')
    assert '--json' in failure(capsys, 'simulate', '--save-model', 'm.yaml', '--json', '-')


@pytest.mark.parametrize('name', ['a.mcap', 'a'])
def test_nothing_is_overwritten(tmp_path, name, capsys):
    """An existing file or folder is refused and keeps its content."""
    path = tmp_path / name
    simulate('--preset', 'idle', '--duration', 1, '--output', path)
    before = {p: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()}
    capsys.readouterr()
    assert 'exists already' in failure(capsys, 'simulate', '--preset', 'idle',
                                       '--duration', '2', '--output', path)
    assert {p: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()} == before
    assert 'does not exist' in failure(
        capsys, 'simulate', '--output', tmp_path / 'none' / 'b.mcap')


@pytest.mark.parametrize('name', ['a.mcap', 'a'])
@pytest.mark.parametrize('model, words', [
    (MODEL.replace('load_sag', 'load_sack'), "'load_sag'"),
    (MODEL.replace('sigma: 0.5', 'sigma: 1e+100'), 'beyond'),
    (MODEL.replace('sigma: 0.5', 'sigma: 1000.0').replace(
        'load_sag\n  params: {linear: 1.0, square: 0.0}',
        'nonlinear_restoring\n  params: {square: 1.0e+6, cube: 0.001}'), 'diverges'),
    (MODEL.replace('load_sag\n  params: {linear: 1.0, square: 0.0}',
                   'jumps\n  params: {rate: 1e12, mean: 0, std: 1}'), 'jumps.rate'),
])
def test_an_error_half_way_leaves_nothing(tmp_path, name, model, words, capsys):
    """A model that cannot be read, or whose simulation fails when the bag is open."""
    (tmp_path / 'm.yaml').write_text(model)
    assert words in failure(capsys, 'simulate', '--model', tmp_path / 'm.yaml', '--duration', 100,
                            '--output', tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == ['m.yaml']


@pytest.mark.parametrize('name, number, status', [
    ('a.mcap', signal.SIGTERM, 143), ('a', signal.SIGINT, 130)])
def test_a_signal_brings_the_old_bag_back(tmp_path, name, number, status):
    # An hour at 20 kHz lasts far longer than the test; the signal goes out once the bag has grown.
    path = tmp_path / name
    simulate('--preset', 'idle', '--duration', 1, '--output', path)
    old = {p: p.stat().st_mtime_ns for p in tmp_path.rglob('*')}
    process = subprocess.Popen(
        [sys.executable, '-m', 'ou_monitor.cli.main', 'simulate', '--duration', '3600', '--rate',
         '20000', '--force', '--output', str(path)], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, env={**os.environ, 'PYTHONPATH': str(ROOT)})
    try:
        end = time.monotonic() + 60.0
        while sum(p.stat().st_size for p in [path, *path.glob('*.mcap')] if p.is_file()) < 1e6:
            assert process.poll() is None and time.monotonic() < end, process.stderr.read()
            time.sleep(0.02)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, out, err) == (status, '', '')
    assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob('*')} == old


def test_the_writer_leaves_nothing_when_finishing_fails(tmp_path, monkeypatch):
    from ou_monitor.recordings.bag import BagWriter
    from ou_monitor.recordings.write import write_recording
    from ou_monitor.records import Recording

    def full(*_):
        raise InputError('disk full')

    t = np.arange(150) / 1e4
    with pytest.raises(InputError, match='disk full'):
        def pieces():
            yield Recording(t, t + 5.0, t * 0.0)
            monkeypatch.setattr(BagWriter, 'write', full)

        write_recording(pieces(), tmp_path / 'a.mcap', type='adc_block', sample_rate=1e4)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('name', ['a.csv', 'a.CSV', 'a.db3', 'a.json'])
def test_a_bag_is_not_named_like_another_file(name, tmp_path, capsys):
    """One line that says what can be written; no folder of that name."""
    said = failure(capsys, 'simulate', '--preset', 'idle', '--output', tmp_path / name)
    assert '.mcap' in said and name in said
    assert list(tmp_path.iterdir()) == []


def test_export_prints_parameters_and_losses(tmp_path, capsys):
    """Parameters on stdout, what is lost on stderr; the pack that is aged sags more."""
    model = str(ROOT / 'models' / 'gecko.yaml')
    assert main(['simulate', '--model', model, '--duration', '5', '--export', 'px4']) == 0
    said = capsys.readouterr()
    assert 'param set SIM_BAT_DRAIN' in said.out and 'load_sag is left out' in said.err
    assert '--capacity-left' in failure(capsys, 'simulate', '--model', model, '--capacity-left',
                                        '2', '--output', tmp_path / 'no.mcap')
    lowest = []
    for name, scale in (('new', '1'), ('old', '1.4')):
        path = tmp_path / f'{name}.mcap'
        simulate('--model', model, '--duration', 10, '--rate', 100, '--capacity-left', 0.8,
                 '--scale-resistance', scale, '--output', path)
        lowest.append(read_recording(path).voltage.min())
    assert lowest[0] - lowest[1] > 0.2


@pytest.mark.parametrize('learned, options, rate', [
    ('rate_hz: 250', [], 250.0), ('rate_hz: 250', ['--rate', '50'], 50.0), ('', [], 1000.0),
    ('rate_hz: fast', [], 1000.0), ('rate_hz: -1', [], 1000.0)])
def test_a_model_is_drawn_at_the_rate_of_its_recording(learned, options, rate, tmp_path):
    """Unless an option says another, or its file, whose provenance is free text, has none."""
    model = tmp_path / 'm.yaml'
    model.write_text('model: [{term: ou, params: {alpha: 9.0, sigma: 0.1, u0: 12.0}}]\n'
                     f'provenance: {{{learned}}}\n')
    path = tmp_path / 'run.mcap'
    simulate('--model', model, '--duration', 2, *options, '--output', path)
    assert read_recording(path).n == 2 * rate


def test_a_saved_model_has_the_rate_of_its_recording(tmp_path):
    flight, model, again = (tmp_path / name for name in ('f.mcap', 'm.yaml', 'again.mcap'))
    simulate('--preset', 'idle', '--rate', 125, '--duration', 8, '--output', flight)
    assert main(['discover', str(flight), '--save-model', str(model)]) == 0
    simulate('--model', model, '--duration', 4, '--output', again)
    assert read_recording(again).n == 500
