"""Formats by the first bytes of a file; the series chosen from a log."""

from pathlib import Path
import subprocess
import sys

from made_logs import blackbox, copter, crazyflie, hover, px4_flight, quad, ulog
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import (
    BAG, detect, FORMATS, import_log, kind_of)
from ou_monitor.recordings.importers.log import (
    clean, CURRENT, Log, log_of, Request, Series, THROTTLE, VOLTAGE)
from packaging.requirements import Requirement
from project import metadata, ROOT
import pytest

CSV = b'time_s,voltage_v,throttle\n0.5,5.0,0.1\n0.6,5.1,0.1\n'


def made(name):
    """Return a small log of a format."""
    return {'ulog': lambda: b''.join(ulog(px4_flight(3)[0])),
            'dataflash': lambda: copter(3)[0].binary,
            'dataflash_text': lambda: copter(3)[0].text,
            'blackbox': lambda: b''.join(blackbox(quad(40))), 'csv': lambda: CSV,
            'crazyflie': lambda: b''.join(crazyflie(*hover(40)[:2]))}[name]()


@pytest.mark.parametrize('name', [one.name for one in FORMATS if one.module])
@pytest.mark.parametrize('ending', ['.ulg', '.bin', '.log', '.bbl', '.csv', ''])
def test_the_first_bytes_decide(tmp_path, name, ending):
    path = tmp_path / ('a' + ending)
    path.write_bytes(made(name))
    assert detect(path).name == name
    assert import_log(path, Request()).format == name


@pytest.mark.parametrize('encoding', ['utf-8', 'cp1252', 'utf-16', 'utf-16-le'])
def test_text_is_known_whatever_its_first_letter_and_encoding(tmp_path, encoding):
    path = tmp_path / 'a.dat'
    path.write_bytes('Übernahme\ntime_s,voltage_v\n0.5,5.0\n0.6,5.1\n'.encode(encoding))
    (voltage,) = import_log(path, Request()).series
    assert voltage.values.tolist() == [5.0, 5.1]


@pytest.mark.parametrize('content, words', [
    (b'', 'is empty'), (b'\x89MCAP0\r\n' + bytes(20), 'an MCAP bag already'),
    (b'\x7fELF' + bytes(100), 'none of the formats that can be read'),
    (b'ULog\x01\x12', 'none of the formats'), (b'\xa3\x95', 'none of the formats'),
    (b'nothing here', "no column 'time_s'"),
])
def test_other_files_are_not_logs(tmp_path, content, words):
    """The error is one line with the likely kind, or with the formats that can be read."""
    path = tmp_path / 'a.ulg'
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        import_log(path, Request())


@pytest.mark.parametrize('name', [one.name for one in FORMATS if one.name not in (BAG, 'csv')])
def test_a_log_given_as_a_recording(tmp_path, name):
    """`analyze` reads it; `replay` asks to convert it first."""
    path = tmp_path / 'flight.log'
    path.write_bytes(made(name))
    with pytest.raises(InputError, match='not a bag: convert it first') as refused:
        BagReader(path)
    assert f'with ou-monitor convert {path} flight' in str(refused.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match='there is no log'):
        detect(tmp_path / 'none.ulg')
    with pytest.raises(InputError, match='is a folder'):
        detect(tmp_path)


@pytest.mark.parametrize('ending, kind', [
    ('.mpt', 'csv'), ('.DTA', 'csv'), ('', 'csv'), ('.mcap', 'mcap'), ('.yaml', 'mcap')])
def test_text_is_a_table_unless_its_name_is_of_a_bag(tmp_path, ending, kind):
    (tmp_path / f'a{ending}').write_bytes(CSV)
    assert kind_of(tmp_path / f'a{ending}') == kind


def test_missing_flight_is_refused(tmp_path):
    path = tmp_path / 'a'
    for name in ('ulog', 'dataflash', 'csv'):
        path.write_bytes(made(name))
        assert import_log(path, Request(flight=1)).series
        with pytest.raises(InputError, match='holds one flight'):
            import_log(path, Request(flight=2))


@pytest.mark.parametrize('name', [one.name for one in FORMATS if one.package])
def test_a_missing_extra_is_named(tmp_path, name):
    """Without its package a format is one line; nothing else needs the package."""
    form = next(one for one in FORMATS if one.name == name)
    path = tmp_path / 'a.log'
    path.write_bytes(made(name))
    (tmp_path / 'a.csv').write_bytes(CSV)
    code = (f'import sys\nsys.modules[{form.package!r}] = None\n'
            'from ou_monitor.cli.main import main\n'
            f'assert main(["convert", {str(tmp_path / "a.csv")!r}, '
            f'{str(tmp_path / "out")!r}]) == 0\n'
            f'sys.exit(main(["convert", {str(path)!r}, "--list"]))')
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True,
                          text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count('\n') == 1
    assert f"pip install '.[{form.module}]'" in done.stderr
    assert form.package in done.stderr


def test_the_extras_are_in_the_metadata():
    """Each extra named to users installs the package that it names, and 'logs' all of them."""
    extras = metadata()['optional-dependencies']
    for form in FORMATS:
        if form.package:
            assert any(form.package in one for one in extras[form.module])
    (every,) = map(Requirement, extras['logs'])
    assert every.extras == {form.module for form in FORMATS if form.package}


PATH = Path('a.ulg')


def series(name='v', quantity=VOLTAGE, t=(0.0, 1.0, 2.0), values=(5.0, 5.1, 5.2), rank=0,
           group=''):
    return Series(name, quantity, np.array(t), np.array(values), '1', 'words', rank, group)


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


COUNT = np.arange(100.0)


@pytest.mark.parametrize('quantity, t, values, kept, words', [
    (VOLTAGE, COUNT[:3], (5.0, 1e300, 5.2), (5.0, 5.2), ['beyond 1e+09']),
    # A sample every few hours; a lone wrong stamp costs one sample.
    (VOLTAGE, 7200.0 * COUNT, COUNT, COUNT, []),
    *((VOLTAGE, np.where(COUNT == 50.0, wrong, COUNT), COUNT, COUNT[COUNT != 50.0], ['1 sample'])
      for wrong in (0.0, 500.0)),
    # A share beyond 0..1 is clipped, with a note if the excess is more than rounding.
    (THROTTLE, COUNT[:3], (-0.001, 0.5, 1.002), (0.0, 0.5, 1.0), []),
    (THROTTLE, COUNT[:3], (-0.1, 0.5, 1.4), (0.0, 0.5, 1.0), ['2 values outside 0..1'])])
def test_what_is_kept_of_a_series(quantity, t, values, kept, words):
    mended, notes = clean(series('u', quantity, t, values))
    np.testing.assert_array_equal(mended.values, kept)
    assert len(notes) == len(words) and all(map(str.__contains__, notes, words))


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
