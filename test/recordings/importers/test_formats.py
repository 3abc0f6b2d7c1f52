"""The table of formats: recognition by the first bytes, and errors."""

import subprocess
import sys

from made_logs import blackbox, copter, crazyflie, hover, px4_flight, quad, ulog
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.importers.formats import (
    BAG, detect, FORMATS, import_log, kind_of)
from ou_monitor.recordings.importers.log import Request
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
