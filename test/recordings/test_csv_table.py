"""CSV recordings, good and bad."""

import time

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.csv_table import CsvColumns, read_csv
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Defect, defect_of
import pytest


def written(tmp_path, text, encoding='utf-8'):
    path = tmp_path / 'log.csv'
    path.write_bytes(text.encode(encoding))
    return path


@pytest.mark.parametrize('text', [
    'time_s,voltage_v,throttle\n0,5.0,0.1\n1,5.5,0.2\n',
    'time_s;voltage_v;throttle\r\n0;5.0;0.1\r\n1;5.5;0.2\r\n',
    'time_s\tvoltage_v\tthrottle\n0\t5.0\t0.1\n1\t5.5\t0.2\n',
    '\ufeff# made by hand\n\nnote, throttle ,voltage_v, time_s\n'
    'a,0.1,5.0,0\n\n# more\n"b, ""c""",0.2,5.5,1\n',
    'time_s,voltage_v,throttle,note\n0,5.0,0.1,"two\nlines"\n1,5.5,0.2,x\n',
    'time_s,voltage_v,throttle\f\n0,5.0,0.1\f\n1,5.5,0.2\f\n',
    'time_s,voltage_v,throttle\n0,5.0,0.1,\n1,5.5,0.2,, \n',
    'time_s,voltage_v,throttle, ,note\n0,5.0,0.1,7,x\n1,5.5,0.2,8,y\n',
])
def test_valid_csv_variants_are_read(tmp_path, text):
    """Delimiters, order, extra columns, a blank name, comments, blank lines and quotes."""
    raw = read_csv(written(tmp_path, text))
    t, voltage, throttle = raw.t, raw.voltage, raw.throttle
    assert t.tolist() == [0.0, 1.0]
    assert voltage.tolist() == [5.0, 5.5]
    assert throttle.tolist() == [0.1, 0.2]
    assert t.dtype == voltage.dtype == throttle.dtype == np.float64


def test_names_of_other_columns_than_the_rows_have_are_not_ignored(tmp_path):
    """Points that became commas: rows have eight cells, so no name can be matched to a cell."""
    rows = ['0,0,12,0,,0,0,n0\n', *(f'0,{k:03d},12,{7 * k},0,{k:02d},0,125,n{k}\n'
                                      for k in range(1, 300))]
    with pytest.raises(InputError, match='header'):
        read_csv(written(tmp_path, 'time_s,voltage_v,throttle,current_a,note\n' + ''.join(rows)))


@pytest.mark.parametrize('blank, held', [(2, False), (3, True)])
def test_a_current_that_most_voltages_lack_is_held(tmp_path, blank, held):
    """One in two is missing at times; one in three is measured at a pace of its own."""
    rows = ''.join(f'{k},12.{k % 7},{"" if k % blank else 1 + k % 5}\n' for k in range(60))
    current = read_csv(written(tmp_path, 'time_s,voltage_v,current_a\n' + rows)).current
    assert np.isfinite(current).all() == held
    assert current[30] == 1.0


@pytest.mark.parametrize('text, words', [
    ('', ['empty', 'time_s,voltage_v']),
    ('# only\n\n', ['empty']),
    ('when,voltage_v\n0,5\n', [':1:', "'time_s'", '--sample-interval']),
    ('time_s,bus\n0,5\n', [':1:', "'voltage_v'", 'valid: bus']),
    ('# x\n0.0,5.0,1\n0.1,5.1,1\n', [':2:', 'header']),
    ('time_s,voltage_v,voltage_v\n0,5,5\n', [':1:', "'voltage_v'", 'twice']),
    ('time_s,voltage_v,time_s\n0,5,5\n', [':1:', "'time_s'", 'twice']),
    *(('time_s,voltage_v\n' + row + ''.join(f'{k},5.{k}\n' for k in range(1, 4)),
       [':2:', f"'{name}' holds 'oops', not a number"])
      for row, name in (('0,oops\n', 'voltage_v'), ('oops,5\n', 'time_s'))),
    ('time_s,voltage_v\n0,5\n\n# x\n1,5.x\n', [':5:', "'voltage_v'", "'5.x'"]),
    ('time_s,voltage_v\n0,5\n1\n', [':3:', 'ends before', "'voltage_v'"]),
    ('time_s,voltage_v\n0,5\n1,0,5,1\n', [':3:', '4 cells', '2 columns', 'decimal mark']),
    ('time_s,voltage_v\n0,0,5,0\n', [':2:', '4 cells']),
    ('time_s;voltage_v\n0,5;5,1\n1;1.20,5\n', [':3:', "'1.20,5'", 'decimal mark is a comma']),
    ('time_s,voltage_v\n0,5\n"1,5\n' + '2,5\n' * 99, [':3:', 'end of data']),
    ('time_s,voltage_v\n0,5\n"1,5\n' + '2,5\n' * 40_000, [':3:', 'close each quote']),
    *(('time_s,voltage_v\n' + rows, ['12345 V', '--decimal .']) for rows in (
        '0.1,5.1\n0.2,"12,345"\n', '0.1,"12,345"\n' * 9)),
    ('time_s,voltage_v\n' + '0.1,"12,3"\n' * 9, [':2:', "'12,3'", 'decimal mark']),
    ('time_s,voltage_v\n0,5\n"1 5\n' + '2 5\n' * 99 + '",5\n', [':3:']),
    ('time_s,voltage_v,note\n0,5,a\n1,5,"b\n2,5,c\n3,5,d"\n4,5,e\n',
     [':3:', 'whole lines', 'close each quote']),
    ('time_s,voltage_v,note\n0,5,a\n1,5,"b"\n2,5,"c"d\n', [':4:', "expected after '"]),
    ('time_s,voltage_v,note\n0,5,a\n1,5,"b\n2,5', [':3:', 'end of data', 'close each quote']),
    ('"time_s,voltage_v,note\n' + ''.join(f'{k},5.{k},n\n' for k in range(9)),
     [':1:', "no column 'voltage_v'"]),
    ('time_s,voltage_v\n0,5\n1,5_01\n', [':3:', "'5_01'", 'not a number']),
    ('time_s,voltage_v\n0,5\n1,\u0665\n', [':3:', 'not a number']),
    ('time_s,voltage_v\n', ['no usable sample']),
    ('time_s,voltage_v\n0,nan\nnan,5\n', ['no usable sample', '2 samples', 'finite']),
])
def test_a_malformed_csv_is_refused_with_the_place(tmp_path, text, words):
    path = written(tmp_path, text)
    with pytest.raises(InputError) as caught:
        read_recording(path)
    found = str(caught.value)
    found = ' '.join(found.split())
    assert 'log.csv' in found and len(found) < len(str(path)) + 150
    for word in words:
        assert word in found


def test_a_binary_file_named_csv_is_refused(tmp_path):
    path = tmp_path / 'log.csv'
    path.write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match='not a table'):
        read_recording(path)
    with pytest.raises(InputError, match='cannot read'):
        read_recording(tmp_path / 'no.csv')


def test_repairs_are_noted(tmp_path):
    """Not finite: dropped. Unsorted: sorted. Repeated: the first kept. Each is counted."""
    text = ('time_s,voltage_v,throttle\n0,5.0,0.0\n2,5.2,\n1,5.1,inf\n1,9.9,0.5\n'
            '3,NaN,0.5\n4,1e300,0.5\n5,,0.5\ninf,5,0.5\n6,5.6,0.6\n')
    recording = read_recording(written(tmp_path, text))
    assert recording.t.tolist() == [0.0, 1.0, 2.0, 6.0]
    assert recording.voltage.tolist() == [5.0, 5.1, 5.2, 5.6]
    # A blank cell holds the value of the line before.
    assert recording.throttle.tolist() == [0.0, 0.0, 0.0, 0.6]
    # An empty cell is normal where each signal has rows of its own, and no defect.
    assert [defect_of(note) for note in recording.notes] == [
        Defect.READER, Defect.NON_FINITE, Defect.UNORDERED, Defect.REPEATED_STAMPS]
    assert recording.notes[0] == "1 row left out: the cell of 'voltage_v' is empty."
    assert recording.notes[1].startswith('3 samples dropped: not a finite')
    assert recording.notes[2].startswith('1 sample came after')
    assert recording.notes[3].startswith('1 sample dropped: repeated stamp')


def test_a_single_sample_is_a_recording(tmp_path):
    """The reader does not judge whether it is enough."""
    recording = read_recording(written(tmp_path, 'time_s,voltage_v\n3,5\n'))
    assert (recording.n, recording.duration) == (1, 0.0)


def test_options_of_bags_are_refused_for_a_csv(tmp_path):
    path = written(tmp_path, 'time_s,voltage_v\n3,5\n')
    with pytest.raises(InputError, match='--msg-config is for bags'):
        read_recording(path, msg_config='px4')


def test_swapped_columns_and_odd_times_are_reported(tmp_path):
    """A time that jumps about beside a voltage that only rises; samples minutes apart."""
    rng = np.random.default_rng(1)
    volts, times = 16.0 + 0.1 * rng.standard_normal(200), 0.01 * np.arange(200)

    def csv(time, voltage):
        return written(tmp_path, 'time_s,voltage_v\n' + ''.join(
            f'{a:.6f},{b:.6f}\n' for a, b in zip(time, voltage)))

    with pytest.raises(InputError, match="'voltage_v' only ever rises: are the two columns swap"):
        read_csv(csv(volts, times))
    with pytest.raises(InputError, match='10000 s apart by .time_s.: is it in ms, us or ns'):
        read_csv(csv(1e6 * times, volts))
    # Sorted by another column, or told in its unit, it is a recording.
    read_csv(csv(times[::-1], volts))
    t = read_csv(csv(1e6 * times, volts), CsvColumns(time_unit='us')).t
    np.testing.assert_allclose(t, times, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('middle, swapped', [(0.5, True), (0.0, False)])
def test_an_ac_coupled_voltage_is_no_throttle(tmp_path, middle, swapped):
    """Beside throttle in percent: volts within 0 to 1 may be swapped with it, others not."""
    rng = np.random.default_rng(1)
    path = written(tmp_path, 'time_s,voltage_v,throttle\n' + ''.join(
        f'{0.01 * k:.2f},{middle + 0.1 * x:.5f},{30.0 + 20.0 * y:.1f}\n'
        for k, (x, y) in enumerate(rng.uniform(-1.0, 1.0, (200, 2)).tolist())))
    if swapped:
        with pytest.raises(InputError, match='stays within 0 to 1 and throttle runs from'):
            read_recording(path)
    else:
        assert 0.1 <= read_recording(path).throttle.min() < 0.15


@pytest.mark.parametrize('columns', [
    {'voltage': 'time_s'}, {'throttle': 'time_s'}, {'current': 'voltage_v'},
    {'throttle': 'voltage_v'}, {'time': 'voltage_v'}, {'time': 'throttle', 'throttle': 'throttle'},
    {'throttle': 'throttle', 'current': 'throttle'}])
def test_one_column_is_one_quantity(tmp_path, columns):
    """Whichever of the two was found, and whichever asked for."""
    path = written(tmp_path, 'time_s,voltage_v,throttle\n0,5,0.1\n1,5.1,0.2\n2,5.2,0.3\n')
    with pytest.raises(InputError, match='cannot be both'):
        read_csv(path, CsvColumns(**columns))


@pytest.mark.parametrize('delimiter', ['', 'ab', '"', '\n'])
def test_what_separates_cells_is_one_character(tmp_path, delimiter):
    """Not none, two, or one that the format needs itself."""
    path = written(tmp_path, 'time_s,voltage_v\n0,5\n1,5.5\n')
    with pytest.raises(InputError, match='--delimiter: .* is not one character'):
        read_csv(path, CsvColumns(delimiter=delimiter))


@pytest.mark.parametrize('above, name, cell', [
    ('sample rate{}x\n', 'n', '0'), ('# x_inc (s){}x\n', 'n', '0'), ('', '({}x', '0'),
    ('', '//{}/ x', '0'), ('', 'n{}/', '0'), ('', 'volt{}x', '0'), ('', 'n', '1:23{}x')])
def test_long_runs_of_blanks_cost_no_time(tmp_path, above, name, cell):
    """10 000 of them above the data, in a name or in a cell: less than a second of CPU."""
    path = written(tmp_path, (f'{above}time_s,voltage_v,{name}\n' + ''.join(
        f'{k},5.{k},{cell}\n' for k in range(3))).replace('{}', ' ' * 10_000))
    begin = time.process_time()
    assert read_csv(path).voltage.tolist() == [5.0, 5.1, 5.2]
    assert time.process_time() - begin < 1.0


@pytest.mark.parametrize('begin, unit', [
    (1.7e12, 1e-3), (1.7e15, 1e-6), (1.7e18, 1e-9), (1.5e9, 1e-6), (0.0, 1e-6)])
def test_a_time_without_a_unit(begin, unit, tmp_path):
    """A date since 1970; 1.5e9 us are 25 minutes since a start-up, not a date of 2017 in s."""
    ticks = [int(begin) + round(0.01 / unit) * k for k in range(200)]
    path = written(tmp_path, 't,U\n' + ''.join(f'{t},{12 + t % 7}\n' for t in ticks))
    found = read_recording(path).t
    assert (found[0] > 1e9) == (begin > 1.6e9) and found[-1] - found[0] == pytest.approx(1.99)


@pytest.mark.parametrize('line, words', [
    ('3.0,1x.2,0.3', "line 302: column 'voltage_v' holds '1x.2', not a number"),
    ('3.0', "line 302: the line ends before column 'throttle'"),
    ('3.0,5.0,0.3,7,8', 'line 302: 5 cells'), ('?,5.0,0.3', "line 302: column 'time_s'"),
    ('3.0,5\0.0,0.3', r"line 302: column 'voltage_v' holds '5\x00.0'"),
    ('?,y,z', "1 bad line left out, such as line 302: column 'time_s'")])
def test_one_bad_line_costs_one_line(line, words, tmp_path):
    rows = [f'{0.01 * k:.2f},{5.0 + 0.01 * (k % 7):.2f},0.3' for k in range(400)]
    good = read_recording(written(tmp_path, '\n'.join(['time_s,voltage_v,throttle', *rows])))
    rows[300] = line
    path = written(tmp_path, '\n'.join(['time_s,voltage_v,throttle', *rows]))
    with pytest.raises(InputError, match='302'):
        read_recording(path)
    found = read_recording(path, partial=True)
    np.testing.assert_array_equal(found.t, np.delete(good.t, 300))
    np.testing.assert_array_equal(found.voltage, np.delete(good.voltage, 300))
    (note,) = found.notes
    assert words in note and '1 bad line left out' in note
    rows[::10] = ['9,bad,0'] * 40
    with pytest.raises(InputError, match='too many to leave out'):
        read_recording(written(tmp_path, '\n'.join(['time_s,voltage_v,throttle', *rows])),
                       partial=True)


@pytest.mark.parametrize('second', ['time_s,throttle,voltage_v', 'time_s,current_a,throttle',
                                    't,temp,rpm'])
def test_a_second_header_with_other_columns_is_refused(second, tmp_path):
    """Rows below it are not mixed with those above; the same header again is one bad line."""
    header, rows = 'time_s,voltage_v,throttle', [f'{0.01 * k:.2f},5.1,0.3' for k in range(400)]
    path = written(tmp_path, '\n'.join([header, *rows[:300], second, *rows[300:]]))
    with pytest.raises(InputError, match=":302: column '.*' becomes '(t|thr|cur).*another"):
        read_recording(path, partial=True)
    path.write_text(path.read_text().replace(second, header))
    assert read_recording(path, partial=True).n == 400


def test_a_bad_date_costs_one_line(tmp_path):
    """A clock that no number was read from is told as such."""
    rows = [f'2024-05-03 14:07:{k:02d},{5.0 + 0.01 * k:.2f}' for k in range(50)]
    rows[20] = '2024-05-03 14:oo:20,5.2'
    path = written(tmp_path, '\n'.join(['time,voltage_v', *rows]))
    found = read_recording(path, partial=True)
    assert found.n == 49 and any("holds '2024-05-03 14:oo:20', not a date" in note
                                 for note in found.notes)
