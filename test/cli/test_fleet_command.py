"""`ou-monitor fleet` for users: complete, with bad files, killed, interrupted, resumed."""

from dataclasses import replace
import json
import os
from pathlib import Path
import resource
import shutil
import signal
import subprocess
import sys
import time

from command_line import failure, write_csv
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.fleet.fleet import run_fleet
from ou_monitor.fleet.table import COLUMNS, NAMES
from ou_monitor.model.ou import simulate
from ou_monitor.recordings.write import write_recording
from ou_monitor.records import Recording
from project import ROOT
import pyarrow
from pyarrow import parquet
import pytest

FLIGHTS = 5
# Starting Python and Dask on a busy machine, s.
PATIENCE = 60.0


def flight(seed: int, sigma: float = 0.4, n: int = 6000) -> Recording:
    """Return an OU of some seconds at 1 kHz, two levels of throttle."""
    t = np.arange(n) * 1e-3
    throttle = np.where(t < t[n // 2], 0.2, 0.5)
    return Recording(t, simulate(t, 63.0, np.full(n, sigma), np.random.default_rng(seed),
                                 u0=5.0 - 0.5 * throttle), throttle, 'made')


def write(path: Path, made: Recording) -> Path:
    """Write a recording as a CSV."""
    return write_csv(path, made.t, made.voltage, made.throttle)


@pytest.fixture(scope='module')
def logs(tmp_path_factory) -> Path:
    """Return a folder of two vehicles, with a bad file, a copy, and what is no recording."""
    folder = tmp_path_factory.mktemp('some logs')
    for k, vehicle in enumerate(('uav1', 'uav2')):
        (folder / vehicle).mkdir()
        for number in range(1, FLIGHTS + 1):
            write(folder / vehicle / f'flight_{number}.csv', flight(100 * k + number))
    dated = flight(7)
    write_recording(replace(dated, t=1.7e9 + dated.t), folder / 'uav2' / 'bag_9', type='float32')
    (folder / 'uav1' / 'bad.mcap').write_text('this is no bag')
    (folder / 'uav1' / 'tuning.csv').write_text('gain,value\n1,2\n')
    (folder / 'uav1' / 'raw.ulg').write_bytes(b'ULog')
    (folder / 'empty').mkdir()
    shutil.copy2(folder / 'uav1' / 'flight_3.csv', folder / 'uav2' / 'stray.csv')
    return folder


def command(*arguments: object) -> list[str]:
    return [sys.executable, '-m', 'ou_monitor.cli.main', 'fleet', *map(str, arguments)]


def environment() -> dict[str, str]:
    """Return an environment with the package of this checkout."""
    return {**os.environ, 'PYTHONPATH': str(ROOT)}


def run(*arguments: object, **options: object) -> subprocess.CompletedProcess:
    """Run the command to its end."""
    return subprocess.run(command(*arguments), capture_output=True, text=True, cwd=ROOT,
                          env=environment(), timeout=PATIENCE, **options)


def parts(out: Path) -> dict[str, int]:
    """Return the results that are kept, with their times."""
    return {p.name: p.stat().st_mtime_ns for p in (out / 'parts').glob('*.json')}


def alive(session: int) -> list[str]:
    """Return the processes of a session that still run."""
    found = []
    for stat in Path('/proc').glob('[0-9]*/stat'):
        try:
            state, _, _, its_session = stat.read_text().rpartition(')')[2].split()[:4]
        except OSError:
            continue
        if int(its_session) == session and state != 'Z':
            found.append(stat.parent.name)
    return found


@pytest.fixture(scope='module')
def story(logs, tmp_path_factory) -> tuple[Path, list, subprocess.CompletedProcess]:
    """
    Run a fleet that is killed, then interrupted, then left to end.

    Returns
    -------
    tuple
        Output folder; for each stop its exit status, standard error, results
        kept before and after, and its processes that outlive it; the last run.

    """
    out = tmp_path_factory.mktemp('fleet') / 'out'
    arguments = (logs, '--output', out, '--workers', 1, '--brownout-voltage', 4.5, '--json',
                 out.parent / 'fleet.json')
    stops = []
    before: dict[str, int] = {}
    for stop in (signal.SIGKILL, signal.SIGINT):
        # In a session of its own, as a terminal has it: Ctrl-C reaches the workers too.
        process = subprocess.Popen(command(*arguments), cwd=ROOT, env=environment(), text=True,
                                   start_new_session=True, stdout=subprocess.PIPE,
                                   stderr=subprocess.PIPE)
        deadline = time.monotonic() + PATIENCE
        try:
            while len(parts(out)) < len(before) + 2 and process.poll() is None:
                assert time.monotonic() < deadline
                time.sleep(0.002)
            if stop == signal.SIGKILL:
                process.kill()
            else:
                os.killpg(process.pid, stop)
            _, said = process.communicate(timeout=PATIENCE)
            while alive(process.pid) and time.monotonic() < deadline:
                time.sleep(0.02)
        finally:
            process.kill()
            process.wait()
        stops.append((process.returncode, said, before, parts(out), alive(process.pid)))
        before = parts(out)
    last = run(*arguments)
    # One of its files is bad.
    assert last.returncode == 2, last.stderr
    return out, stops, last


@pytest.fixture(scope='module')
def whole(story) -> tuple[Path, subprocess.CompletedProcess]:
    """Return the output of the run that ended, and what it said."""
    return story[0], story[2]


@pytest.fixture(scope='module')
def rows(whole) -> list[dict]:
    return parquet.read_table(whole[0] / 'fleet.parquet').to_pylist()


def test_every_recording_has_its_rows(rows):
    levels: dict[str, list] = {}
    for row in rows:
        levels.setdefault(Path(row['path']).name, []).append(row['throttle'])
    for number in range(1, FLIGHTS + 1):
        # Two vehicles have a flight of this name; throttle is that of the file.
        assert levels[f'flight_{number}.csv'] == [pytest.approx(0.2), pytest.approx(0.5)] * 2
    assert levels['bag_9'] == [pytest.approx(0.2), pytest.approx(0.5)]
    assert levels['bad.mcap'] == levels['stray.csv'] == [None]
    assert set(levels) == {f'flight_{n}.csv' for n in range(1, FLIGHTS + 1)} | {
        'bag_9', 'bad.mcap', 'stray.csv'}


def test_the_numbers_are_those_of_analyze(rows, logs):
    from ou_monitor.analysis.analyze import analyze
    from ou_monitor.recordings.read import read_recording
    path = logs / 'uav2' / 'flight_5.csv'
    alone = analyze(read_recording(path), brownout_voltage=4.5)
    mine = [row for row in rows if row['path'] == str(path.resolve())]
    for row, level in zip(mine, alone.levels, strict=True):
        for name in ('alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'u0'):
            assert row[name] == pytest.approx(getattr(level.estimate, name), rel=1e-7)
        assert 0.0 <= row['risk'] <= 1.0


def test_resistance_and_sag_are_those_of_analyze(tmp_path, one_process, capsys):
    rng = np.random.default_rng(2)
    t = np.arange(1500) * 0.02
    logs = tmp_path / 'logs' / 'uav7'
    logs.mkdir(parents=True)
    for k, rest in enumerate((16.4, 13.2)):
        throttle = np.repeat(rng.uniform(0.1, 0.9, 60), 25)
        current = 40.0 * throttle ** 1.8
        volts = rest - 0.03 * current + 0.02 * rng.standard_normal(t.size)
        lines = [f'{a:.2f},{b:.3f},{c:.3f},{d:.2f}' for a, b, c, d in zip(
            t, volts, throttle, current)]
        if k:
            lines[700] = '14.00,1x.3,0.2,3'
        (logs / f'f_2024-05-0{k + 1}.csv').write_text('\n'.join(
            ['time_s,voltage_v,throttle,current_a', *lines]))
    assert main(['fleet', str(logs.parent), '--output', str(tmp_path / 'out')]) == 0
    said = capsys.readouterr().out
    rows = {row['recording']: row for row in parquet.read_table(
        tmp_path / 'out' / 'fleet.parquet').to_pylist()}
    assert main(['analyze', str(logs / 'f_2024-05-01.csv'), '--json', str(tmp_path / 'a')]) == 0
    row, last = rows['f_2024-05-01.csv'], rows['f_2024-05-02.csv']
    supply = json.loads((tmp_path / 'a').read_text())['supply']
    assert json.loads(row['supply']) == supply
    assert (row['resistance'], row['resistance_se']) == (
        supply['resistance']['ohm'], supply['resistance']['se_ohm'])
    assert (row['sag_full'], row['lowest']) == (
        supply['sag']['sag_v'][-1], supply['lowest']['voltage_v'])
    assert abs(row['resistance'] - 0.03) < 2.0 * row['resistance_se']
    # 13.2 V alone would be three cells.
    assert [(one['cells'], one['cells_from'], one['start_from'], one['samples'])
            for one in (row, last)] == [(4, 'guessed', 'name', 1500), (4, 'guessed', 'name', 1499)]
    (note,) = (note for note in last['notes'] if 'bad line' in note)
    assert "1 bad line left out, such as line 702: column 'voltage_v' holds '1x.3'" in note
    # It is told with vehicle and file, and so is the resistance.
    told = ' '.join(said.split())
    assert 'uav7: f_2024-05-02.csv: 1 bad line left out' in told
    assert f"{1e3 * row['resistance']:.1f}" in told and '4?' in told
    # Columns and series are chosen as in analyze, and other ones are another run.
    assert main(['fleet', str(logs.parent), '--output', str(tmp_path / 'out'),
                 '--current-column', 'none']) == 0
    table = parquet.read_table(tmp_path / 'out' / 'fleet.parquet').to_pylist()
    assert [one['resistance'] for one in table] == [None] * len(table)
    assert all(one['sag_full'] is not None for one in table)


def test_bad_files_are_rows(rows, whole):
    """The reason is in the row and on the terminal; the others are not harmed."""
    (bad,) = (row for row in rows if row['error'])
    assert bad['path'].endswith('bad.mcap') and 'not an MCAP file' in bad['error']
    assert 'bad.mcap is not an MCAP file' in ' '.join(whole[1].stdout.split())
    assert 'Traceback' not in whole[1].stderr


def test_copies_are_analysed_once_and_named(rows, whole):
    """The copy points to the original, which is the older one, and the other vehicle is told."""
    (copy,) = (row for row in rows if row['duplicate_of'])
    assert copy['path'].endswith('stray.csv') and copy['sigma'] is None
    assert copy['duplicate_of'].endswith('flight_3.csv') and copy['flight'] is None
    said = ' '.join(whole[1].stdout.split())
    assert '1 is a copy of another' in said and 'one of the two is in the wrong place' in said


def test_skipped_files_are_named(whole):
    """A CSV of something else and what only ends like a log are named."""
    said = ' '.join(whole[1].stdout.split())
    assert 'tuning.csv' in said and 'raw.ulg' in said and 'in no known format' in said


def test_vehicles_flights_and_dates(rows, whole):
    flights = {(row['vehicle'], row['flight']) for row in rows if row['flight']}
    assert flights == {(v, k) for v, last in (('uav1', FLIGHTS), ('uav2', FLIGHTS + 1))
                       for k in range(1, last + 1)}
    dated = {row['recording']: row['start'] for row in rows if row['start']}
    assert set(dated) == {'bag_9'} and dated['bag_9'].timestamp() == 1_700_000_000
    said = ' '.join(whole[1].stdout.split())
    assert 'vehicles by their folder' in said and 'the order of names decides' in said


def test_each_column_has_unit_and_meaning(whole):
    table = parquet.read_table(whole[0] / 'fleet.parquet')
    assert tuple(table.column_names) == NAMES
    for column in COLUMNS:
        field = table.schema.field(column.name)
        assert field.metadata[b'unit'].decode() == column.unit and field.metadata[b'meaning']
    assert pyarrow.types.is_timestamp(table.schema.field('start').type)
    data = json.loads((whole[0].parent / 'fleet.json').read_text())
    assert len(data['rows']) == table.num_rows and data['failed'] == data['duplicates'] == 1
    assert [row['sigma'] for row in data['rows']] == table.column('sigma').to_pylist()


def test_columns_are_documented():
    text = (ROOT / 'doc' / 'fleet.md').read_text(encoding='utf-8')
    for column in COLUMNS:
        assert f'| `{column.name}` | {column.unit or "-"} |' in text


def test_an_interrupted_run_keeps_its_results(story):
    """SIGKILL and Ctrl-C come in the middle; nothing of before is done again, nobody is left."""
    out, stops, _ = story
    for code, said, before, after, left in stops:
        assert len(before) < len(after) < 2 * FLIGHTS + 1
        assert before.items() <= after.items() and not left
    assert [code for code, *_ in stops] == [-signal.SIGKILL, 130]
    # One line for a person who pressed Ctrl-C, of all processes together.
    (line,) = stops[1][1].splitlines()
    assert 'are kept' in line
    assert stops[1][3].items() <= parts(out).items() and len(parts(out)) == 2 * FLIGHTS + 1
    assert not list((out / 'parts').glob('*.draft'))


def test_killed_and_resumed_gives_the_same(logs, rows, tmp_path, one_process):
    """The table is that of a run in one go, here without other processes."""
    again = tmp_path / 'out'
    assert main(['fleet', str(logs), '--output', str(again), '--brownout-voltage', '4.5']) == 2
    other = parquet.read_table(again / 'fleet.parquet').to_pylist()
    assert len(other) == len(rows)
    for mine, one in zip(rows, other):
        for name, value in one.items():
            assert mine[name] == (pytest.approx(value, rel=1e-7, abs=1e-12)
                                  if isinstance(value, float) else value), name
    assert (again / 'fleet.html').read_text().startswith('<!DOCTYPE html>')


def refused(capsys, *arguments: object) -> str:
    return failure(capsys, 'fleet', *arguments)


@pytest.mark.parametrize('arguments, words', [
    (['LOGS/empty', '--output', 'OUT'], ['no recording in', 'columns of time and voltage']),
    (['LOGS/none', '--output', 'OUT'], ['there is no recording or folder', 'none']),
    (['', '--output', 'OUT'], ['the path is empty']),
    (['LOGS', '--output', 'LOGS/uav1/bad.mcap'], ['is a file: name a folder']),
    (['LOGS', '--output', 'LOGS/uav1/bad.mcap/inside'], ['cannot write into', 'Not a directory']),
    (['LOGS', '--output', 'OUT', '--workers', '0'], ['--workers', 'from 1']),
    (['LOGS', '--output', 'OUT', '--workers', '1', '--scheduler', 'tcp://x:1'], ['give one']),
    (['LOGS', '--output', 'OUT', '--scheduler', 'nonsense://x'], ['--scheduler', 'nonsense']),
    (['LOGS', '--output', 'OUT', '--scheduler', 'nonsense://x', '--insecure'],
     ['--scheduler', 'nonsense', 'no scheduler answers']),
    (['LOGS', '--output', 'OUT', '--scheduler', 'tls://127.0.0.1:9'], ['no scheduler answers']),
    (['LOGS', '--output', 'OUT', '--scheduler', 'tcp://10.0.0.2:8786'], ['not encrypted']),
    (['LOGS', '--output', 'OUT', '--insecure'], ['--insecure is for --scheduler']),
    (['LOGS', '--output', 'OUT', '--vehicle-from', '('], ['--vehicle-from', 'regular expression']),
    (['LOGS', '--output', 'OUT', '--seed', '-1'], ['--seed']),
    (['LOGS', '--output', 'OUT', '--msg-config', 'no_such'], ['no_such']),
    (['LOGS', '--output', 'OUT', '--levels', '2'], ['--levels']),
    (['LOGS', '--output', 'OUT', '--window', '1e-9'], ['--window', 'not within']),
    (['LOGS', '--output', 'OUT', '--json', 'OUT/fleet.html'], ['--json', 'are both']),
    (['LOGS', '--output', 'OUT', '--force', '--json', 'LOGS/uav1/bad.mcap'],
     ['would overwrite']),
])
def test_bad_input_is_one_line(arguments, words, logs, tmp_path, capsys):
    """What was wrong, where, what to do; exit status 2, and nothing is left behind."""
    given = [a.replace('LOGS', str(logs)).replace('OUT', str(tmp_path / 'out'))
             for a in arguments]
    said = refused(capsys, *given)
    assert all(word in said for word in words), said


@pytest.mark.parametrize('name', ['fleet.html', 'fleet.parquet', 'parts/ou_monitor_fleet.txt'])
def test_files_in_a_folder_of_that_shape_are_not_its_own(name, tmp_path, one_process, capsys):
    out = tmp_path / 'out'
    (out / 'parts').mkdir(parents=True)
    (out / name).write_text('precious')
    given = ['fleet', str(write(tmp_path / 'a.csv', flight(1, n=3000))), '--output', str(out)]
    refused(capsys, *given[1:])
    assert (out / name).read_text() == 'precious'
    if not name.startswith('parts'):
        assert main([*given, '--force']) == main(given) == 0
        assert (out / name).read_bytes() != b'precious'


@pytest.mark.parametrize('name', ['fleet.html', 'fleet.parquet'])
def test_an_output_is_replaced_only_if_its_content_is_of_fleet(name, tmp_path, one_process,
                                                               capsys, monkeypatch):
    """Before the work and before the write; --force replaces any."""
    out = tmp_path / 'out'
    again = ['fleet', str(write(tmp_path / 'a.csv', flight(1, n=3000))), '--output', str(out)]
    assert main(again) == 0 and main(again) == 0
    made = {path.name: path.read_bytes() for path in out.glob('fleet.*')}
    table = pyarrow.table({'vehicle': ['mine'], 'vehicle_from': ['mine']})
    parquet.write_table(table, tmp_path / 'other.parquet')
    for content in (b'mine', b'', b'PAR1minePAR1', (tmp_path / 'other.parquet').read_bytes(),
                    b'<!DOCTYPE html>\n<title>Supply noise of a fleet</title></body></html>\n',
                    made[name] + b'my remark'):
        (out / name).write_bytes(content)
        capsys.readouterr()
        assert f"{name}' was not written by fleet" in refused(capsys, *again[1:])
        assert {p.name: p.read_bytes() for p in out.glob('fleet.*')} == {**made, name: content}
    assert main([*again, '--force']) == 0 and (out / name).read_bytes() != content
    capsys.readouterr()

    def meanwhile(*given, **options):
        (out / name).write_bytes(b'mine')
        return run_fleet(*given, **options)
    monkeypatch.setattr('ou_monitor.fleet.fleet.run_fleet', meanwhile)
    others = {p.name: p.read_bytes() for p in out.glob('fleet.*') if p.name != name}
    assert f"{name}' was not written by fleet" in refused(capsys, *again[1:])
    assert {p.name: p.read_bytes() for p in out.glob('fleet.*')} == {**others, name: b'mine'}


def test_a_fleet_of_bad_files_alone_is_refused(tmp_path, one_process, capsys):
    """The table with its error is there, and so are exit status and line."""
    bad = tmp_path / 'bad.mcap'
    bad.write_bytes(b'no bag')
    assert main(['fleet', str(bad), '--output', str(tmp_path / 'out')]) == 2
    assert '1 of 1 recording could not be analysed' in capsys.readouterr().err
    table = parquet.read_table(tmp_path / 'out' / 'fleet.parquet')
    assert 'not an MCAP file' in table.column('error').to_pylist()[0]


def test_millisecond_stamps_are_refused_and_odd_names_shown(tmp_path, one_process):
    """Stamps in milliseconds since 1970 fail the run; a name that is no text is still told."""
    made = flight(1, n=3000)
    logs = tmp_path / 'logs'
    logs.mkdir()
    np.savetxt(logs / 'ms.csv', np.column_stack([1.7e12 + 1e3 * made.t, made.voltage]), '%.16g',
               ',', header='time_s,voltage_v', comments='')
    write(logs / os.fsdecode(b'\xff.csv'), made)
    assert main(['fleet', str(logs), '--output', str(tmp_path / 'out')]) == 2
    rows = parquet.read_table(tmp_path / 'out' / 'fleet.parquet').to_pylist()
    assert {row['recording']: row['start'] for row in rows} == {
        'ms.csv': None, '\\udcff.csv': None}
    assert {row['recording']: 'ms, us or ns' in (row['error'] or '') for row in rows} == {
        'ms.csv': True, '\\udcff.csv': False}


def test_two_packs_in_one_folder_are_said(tmp_path, one_process, capsys):
    """A 1S and a 3S are one vehicle by their folder: said, for they are compared as one."""
    made = flight(1, n=1500)
    for name, factors in (('mixed', (1.0, 3.0)), ('same', (1.0, 1.3))):
        logs = tmp_path / name
        logs.mkdir()
        for k, factor in enumerate(factors):
            write_csv(logs / f'{k}.csv', made.t, factor * made.voltage, made.throttle)
    assert main(['fleet', str(tmp_path), '--output', str(tmp_path / 'out'), '--json',
                 str(tmp_path / 'x.json')]) == 0
    said = [note for note in json.loads((tmp_path / 'x.json').read_text())['notes']
            if 'different supplies' in note]
    assert [note.split(':')[0] for note in said] == ['mixed'] and '--vehicle-from' in said[0]


def test_missing_extra_is_named(logs, tmp_path, capsys, monkeypatch):
    """Without Dask or Arrow the line says what to install."""
    import importlib.util
    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, 'find_spec',
                        lambda name, *a: None if name == 'pyarrow' else real(name, *a))
    said = refused(capsys, logs, '--output', tmp_path / 'out')
    assert 'pyarrow is not installed: ' in said and "pip install '.[fleet]'" in said


def test_a_full_disk_is_reported_before_the_work(logs, tmp_path):
    """Nothing can be written: one line, at once, also where one is root."""
    done = run(logs, '--output', tmp_path / 'out', preexec_fn=lambda: resource.setrlimit(
        resource.RLIMIT_FSIZE, (0, 0)))
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert 'cannot write' in done.stderr and 'File too large' in done.stderr
