"""The fleet's disk and processes: workers that die, saved results, search."""

from datetime import datetime, timezone
import os
from pathlib import Path
import resource
import signal
import time
from types import SimpleNamespace

from made_logs import crazyflie, hover
import numpy as np
from ou_monitor.analysis.crafts import likely_cells
from ou_monitor.errors import InputError
from ou_monitor.fleet.analysis import Options, work
from ou_monitor.fleet.find import duplicates, find_recordings
from ou_monitor.fleet.fleet import _guess_together, SavedResults
from ou_monitor.fleet.vehicles import assign, natural, number_flights, read_pattern, start_of
from ou_monitor.fleet.workers import check_address, LocalWorkers, LOST, usable_memory
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Recording
from ou_monitor.report.fleet_document import failure_words
from ou_monitor.stream.files import write_whole
import pytest


def deadly(task: int, folder: str) -> dict:
    """Die by SIGKILL: always for task 3, the first time for task 5; else tell of the process."""
    mark = Path(folder) / f'tried_{task}_{os.getpid()}'
    mark.touch()
    tries = len(list(Path(folder).glob(f'tried_{task}_*')))
    # If task 3 died before task 5 had begun, task 5 would die for the first time when it is alone.
    end = time.monotonic() + 60.0
    while task == 3 and not list(Path(folder).glob('tried_5_*')) and time.monotonic() < end:
        time.sleep(0.01)
    if task == 3 or (task == 5 and tries == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return {'task': task, 'threads': {name: os.environ.get(name) for name in (
        'OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')}}


def test_a_worker_that_dies_is_one_row(tmp_path):
    with LocalWorkers(2) as pool:
        done = list(pool.each(deadly, [(k, str(tmp_path)) for k in range(8)]))
    results = {k: result for k, result, why in done if not why}
    assert {k: why for k, _, why in done if why} == {3: LOST}
    assert sorted(results) == [0, 1, 2, 4, 5, 6, 7]
    # Twice each, in two processes.
    assert len(list(tmp_path.glob('tried_3_*'))) == len(list(tmp_path.glob('tried_5_*'))) == 2
    # One thread of linear algebra in each, whatever the machine has.
    assert all(set(result['threads'].values()) == {'1'} for result in results.values())


def sockets(process: int | str) -> set[str]:
    found = set()
    for link in Path(f'/proc/{process}/fd').iterdir():
        try:
            target = os.readlink(link)
        except OSError:
            continue
        if target.startswith('socket:'):
            found.add(target)
    return found


def look(_: int) -> dict:
    """Return what a worker has open, and its limit of memory."""
    return {'sockets': sorted(sockets('self')), 'pid': os.getpid(),
            'memory': resource.getrlimit(resource.RLIMIT_DATA)[0]}


def test_no_process_opens_a_socket():
    before = sockets('self')
    with LocalWorkers(2) as pool:
        done = [result for _, result, why in pool.each(look, [(k,) for k in range(4)]) if not why]
        assert sockets('self') == before
    assert len(done) == 4 and all(set(result['sockets']) <= before for result in done)
    limits = {result['memory'] for result in done}
    assert len(limits) == 1 and 2 * limits.pop() <= usable_memory()


def fill(size: int) -> str:
    """Ask for some memory, byte; say what became of it."""
    try:
        return f'{len(bytearray(size))}'
    except MemoryError:
        return 'refused'


def test_a_worker_has_its_share_of_the_memory(monkeypatch):
    """A larger allocation fails in the worker, which continues."""
    monkeypatch.setattr('ou_monitor.fleet.workers.usable_memory', lambda: 2 << 30)
    with LocalWorkers(2) as pool:
        done = {k: result for k, result, _ in pool.each(fill, [(1 << 20,), (3 << 29,), (9,)])}
    assert done == {0: str(1 << 20), 1: 'refused', 2: '9'}


def unpicklable(_: int) -> object:
    """Return what cannot come back."""
    return lambda: None


def test_a_result_that_cannot_come_back_is_one_row():
    with LocalWorkers(1) as pool:
        found = list(pool.each(unpicklable, [(0,), (1,)]))
    assert [k for k, _, _ in found] == [0, 1]
    assert all('The worker failed' in why and '\n' not in why for _, _, why in found)


@pytest.mark.parametrize('address, fine', [
    ('tls://10.0.0.2:8786', True), ('tcp://127.0.0.1:8786', True), ('tcp://[::1]:8786', True),
    ('localhost:8786', True), ('127.9.9.9:1', True), ('tcp://10.0.0.2:8786', False),
    ('10.0.0.2:8786', False), ('tcp://localhost.example.org:8786', False), ('x', False),
    ('ws://10.0.0.2:8786', False), ('tcp://0.0.0.0:8786', False), ('tcp://', False)])
def test_a_scheduler_of_another_machine_wants_tls(address, fine):
    check_address(address, insecure=True)
    if fine:
        check_address(address)
    else:
        with pytest.raises(InputError, match='not encrypted.*tls://HOST:PORT, or --insecure'):
            check_address(address)


def test_a_failure_names_its_path_once():
    errors = {'/f/a.csv': '/f/a.csv:1: no column', '/f/bag': '/f/bag/bag_0.mcap is damaged',
              '/f/b.mcap': '/f/b.mcap is empty', '/f/c': 'something else'}
    fleet = SimpleNamespace(failed=[
        {'path': p, 'error': e, 'vehicle': 'v' if p == '/f/c' else None}
        for p, e in errors.items()])
    assert failure_words(fleet) == ['/f/a.csv:1: no column', '/f/bag/bag_0.mcap is damaged',
                                    '/f/b.mcap is empty', 'v: /f/c: something else']


def test_work_never_raises(tmp_path, monkeypatch):
    """A bad file, a bug and a lack of memory are errors in the result."""
    bad = tmp_path / 'bad.csv'
    bad.write_text('time_s,voltage_v\n')
    assert 'bad.csv' in work(str(bad), Options())['error']
    for error, words in ((ZeroDivisionError('x'), 'ZeroDivisionError: x'),
                         (MemoryError(), 'fewer workers')):
        def broken(*_: object, error=error, **__: object) -> None:
            raise error
        monkeypatch.setattr('ou_monitor.fleet.analysis.read_recording', broken)
        assert words in work(str(bad), Options())['error']


def csv_file(path: Path, value: float = 1.0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('time_s,voltage_v\n' + ''.join(f'{k},{value}\n' for k in range(3)))
    return path


def test_bags_are_found_as_bags(tmp_path):
    """A folder with metadata, or cut off before it was written, is one recording."""
    (tmp_path / 'a' / 'whole').mkdir(parents=True)
    (tmp_path / 'a' / 'whole' / 'metadata.yaml').touch()
    (tmp_path / 'a' / 'whole' / 'anything.mcap').touch()
    (tmp_path / 'a' / 'cut').mkdir()
    for k in (0, 1):
        (tmp_path / 'a' / 'cut' / f'cut_{k}.mcap').touch()
    (tmp_path / 'b').mkdir()
    for name in ('one.mcap', 'two.MCAP'):
        (tmp_path / 'b' / name).touch()
    csv_file(tmp_path / '.hidden' / 'flight.csv')
    csv_file(tmp_path / 'out' / 'flight.csv')
    found = find_recordings([str(tmp_path), str(tmp_path / 'b' / 'one.mcap'),
                             str(tmp_path / 'a' / 'whole' / 'metadata.yaml')],
                            leave_out=tmp_path / 'out')
    assert [s.path.relative_to(tmp_path.resolve()).as_posix() for s in found.sources] == [
        'a/cut', 'a/whole', 'b/one.mcap', 'b/two.MCAP']


def test_logs_are_read_as_analyze_reads_them(tmp_path):
    """They are recognised by their first bytes; an unreadable log costs only its own row."""
    events, records, _ = hover(3000, refresh=5)
    log = tmp_path / 'LOG.TXT'
    log.write_bytes(b''.join(crazyflie(events, records)))
    cut = tmp_path / 'cut.bin'
    cut.write_bytes(b''.join(crazyflie(events, records))[:40])
    (tmp_path / 'log00').write_bytes(log.read_bytes())
    (tmp_path / 'notes.txt').write_text('these are notes')
    (tmp_path / 'other.bin').write_bytes(b'something else')
    found = find_recordings([str(tmp_path)])
    assert [source.path.name for source in found.sources] == [
        'LOG.TXT', 'cut.bin', 'log00']
    assert len(found.notes) == 1 and 'other.bin' in found.notes[0]
    results = {source.path.name: work(str(source.path), Options())
               for source in found.sources}
    assert results['LOG.TXT']['samples'] == results['log00']['samples'] == read_recording(log).n
    assert results['cut.bin']['error']


def test_the_folder_of_the_recordings_is_no_output(tmp_path):
    """It would be left out, and nothing found."""
    with pytest.raises(InputError, match='--output is the folder of the recordings'):
        find_recordings([str(tmp_path)], leave_out=tmp_path / '..' / tmp_path.name)


def test_copies_are_found_by_content_not_by_name(tmp_path):
    """Equal bytes are equal, equal size is not; of three the oldest is the original."""
    young, old, other = (csv_file(tmp_path / name) for name in ('a.csv', 'b.csv', 'c.csv'))
    csv_file(tmp_path / 'd.csv', 2.0)
    for path, stamp in ((young, 300), (old, 100), (other, 200)):
        os.utime(path, (stamp, stamp))
    found = duplicates(find_recordings([str(tmp_path)]).sources)
    assert found == {young.resolve(): old.resolve(), other.resolve(): old.resolve()}


def test_parts_hold_for_the_same_recording_and_options(tmp_path):
    """A change of the file or of an option makes the work be done again."""
    path = csv_file(tmp_path / 'a.csv')

    def source():
        return find_recordings([str(path)]).sources[0]

    parts = SavedResults(tmp_path / 'out', {'window': 2.0})
    parts.save(source(), {'error': '', 'sigma': 0.1 + 0.2, 'nothing': float('nan')})
    again = SavedResults(tmp_path / 'out', {'window': 2.0})
    assert again.load(source())['sigma'] == 0.1 + 0.2
    assert SavedResults(tmp_path / 'out', {'window': 3.0}).load(source()) is None
    os.utime(path, ns=(1, 1))
    assert again.load(source()) is None


def test_a_fifo_in_the_place_of_a_draft_hangs_nothing(tmp_path):
    target, elsewhere = tmp_path / 'report.html', tmp_path / 'elsewhere'
    draft = tmp_path / f'.report.html.{os.getpid()}.draft'
    os.mkfifo(draft)
    write_whole(target, b'new')
    elsewhere.write_bytes(b'kept')
    draft.symlink_to(elsewhere)
    write_whole(target, b'newer')
    assert (target.read_bytes(), elsewhere.read_bytes()) == (b'newer', b'kept')
    os.remove(target)
    os.mkfifo(target)
    write_whole(target, b'newest')
    assert target.read_bytes() == b'newest' and not draft.exists()


def paths(*names: str) -> dict[Path, str]:
    """Return recordings without a stated vehicle."""
    return {Path(name): '' for name in names}


def test_a_vehicle_is_named_by_metadata_pattern_or_folder():
    found, notes = assign({**paths('/f/uav1/a.csv', '/x/logs/a.csv', '/y/logs/a.csv'),
                           Path('/z/b.mcap'): 'SN42'})
    assert [v.name for v in found.values()] == ['uav1', 'x/logs', 'y/logs', 'SN42']
    assert len(notes) == 1 and '1 vehicle by their metadata' in notes[0]
    found, notes = assign({**paths('/f/uav1_007.csv', '/f/other.csv'),
                           Path('/f/uav2_b.mcap'): 'SN42'}, read_pattern(r'(uav\d)_'))
    assert [v.name for v in found.values()] == ['uav1', '', 'SN42']
    assert any("'/f/other.csv': --vehicle-from finds no vehicle" in note for note in notes)
    assert any('the metadata are used' in note for note in notes)


def test_ambiguous_vehicles_are_not_pooled():
    """Beside recordings that name their vehicle, one that does not is compared with nothing."""
    found, notes = assign({Path('/f/a.mcap'): 'SN1', Path('/f/b.mcap'): 'SN2',
                           Path('/f/c.mcap'): ''})
    assert [v.name for v in found.values()] == ['SN1', 'SN2', '']
    assert any("'/f/c.mcap': the metadata lack the vehicle" in note for note in notes)
    found, notes = assign({Path('/f/a.mcap'): 'uav1', Path('/uav1/b.mcap'): ''})
    assert any('check that it is one vehicle' in note for note in notes)


def test_flights_are_in_order_of_date_or_else_of_name():
    """If a date is missing, the order is by name, if one occurs twice, within it; with a note."""
    nan = float('nan')
    names = [Path(f'/u/flight_{k}.csv') for k in (10, 9, 1)]
    vehicles, _ = assign(dict.fromkeys(names, ''))
    flights, notes = number_flights(vehicles, dict(zip(names, (1.0, 2.0, 3.0))))
    assert [flights[path] for path in names] == [1, 2, 3] and not notes
    for dates, order in (((1.0, 1.0, 2.0), [2, 1, 3]), ((1.0, nan, 2.0), [3, 2, 1])):
        flights, notes = number_flights(vehicles, dict(zip(names, dates)))
        assert [flights[path] for path in names] == order
        assert 'order of names' in notes[0]
    assert sorted(['f10', 'f9', 'g1', 'f'], key=natural) == ['f', 'f9', 'f10', 'g1']


@pytest.mark.parametrize('name, source, t, date, origin', [
    ('f.csv', {}, 1.7e9, '2023-11-14T22:13:20', 'stamps'),
    ('2024-05-03.bbl', {'started': '2022-02-02T15:04:53.000+00:00'}, 0.0, '2022-02-02T15:04:53',
     'log'),
    ('bag', {'log_started': '2022-02-02T15:04:53'}, 5.0, '2022-02-02T15:04:53', 'log'),
    ('LOG_2024-05-03_14-07-12.bbl', {}, 0.0, '2024-05-03T14:07:12', 'name'),
    ('2022_02_25 21_25_39 Fri.csv', {}, 0.0, '2022-02-25T21:25:39', 'name'),
    ('flight_20240503T1407.csv', {'started': 'no date'}, 0.0, '2024-05-03T14:07:00', 'name'),
    ('log_7_2024-5-3-14-07-12.bin', {}, 0.0, '2024-05-03T14:07:12', 'name'),
    ('uav3_2024-05-03_2.csv', {}, 0.0, '2024-05-03T00:00:00', 'name'),
    ('flight_20241399.csv', {}, 0.0, None, ''), ('120240503.csv', {}, 0.0, None, ''),
    ('flight_12.csv', {}, 0.0, None, '')])
def test_the_date_comes_from_stamps_header_or_name(name, source, t, date, origin):
    at = np.array([t, t + 1.0])
    start, found = start_of(Recording(at, at, None, name, source))
    assert found == origin
    assert (None if np.isnan(start) else datetime.fromtimestamp(start, timezone.utc).isoformat(
        ).removesuffix('+00:00')) == date


def test_cells_that_a_recording_cannot_have_are_an_error(tmp_path):
    """As in analyze; the number given is that of the row."""
    t = np.arange(400) * 0.01
    path = tmp_path / 'pack.csv'
    rng = np.random.default_rng(1)
    path.write_text('time_s,voltage_v\n' + ''.join(
        f'{a:.2f},{b:.3f}\n' for a, b in zip(t, 16.0 + 0.05 * rng.standard_normal(t.size))))
    right, wrong = (work(str(path), Options(cells=cells)) for cells in (4, 9))
    assert (right['error'], right['cells'], right['cells_from']) == ('', 4, 'given')
    assert 'it is likely 4 cells' in wrong['error'] and not wrong['levels']


@pytest.mark.parametrize('factor, why', [(1e3, 'is it in mV'), (-1.0, 'negative'), (0.0, 'stuck')])
def test_a_recording_whose_voltage_means_nothing_is_left_out(tmp_path, factor, why):
    """It would head the report with 16000 V, and be compared with the others."""
    path = tmp_path / 'pack.csv'
    noise = np.random.default_rng(1).standard_normal(400)
    path.write_text('time_s,voltage_v\n' + ''.join(
        f'{0.01 * k:.2f},{factor * (16.0 + 0.05 * one):.4f}\n' for k, one in enumerate(noise)))
    for cells in (0, 4):
        assert why in work(str(path), Options(cells=cells))['error']


@pytest.mark.parametrize('full, others, cells', [
    (13.6, (4,), 4), (13.2, (4,), 4), (5.1, (4,), 0), (12.6, (4,), 3), (16.8, (5,), 4),
    (26.1, (6, 8), 6), (21.2, (6,), 0), (66.0, (), 0), (66.0, (16,), 16), (66.0, (16, 17), 0)])
def test_a_pack_has_the_cells_that_its_vehicle_allows(full, others, cells):
    """13.2 V is four empty cells rather than three overfull ones; 21.2 V may be 5 or 6."""
    guess = likely_cells(full)
    one = {'cells': guess[0] if len(guess) == 1 else None, 'full_v': full,
           'cells_from': 'guessed' if len(guess) == 1 else 'unknown'}
    _guess_together([one, *({'cells': n, 'cells_from': 'log', 'full_v': 4.1 * n}
                            for n in others)])
    assert (one['cells'] or 0, one['cells_from']) == (cells, 'guessed' if cells else 'unknown')
