"""ArduPilot dataflash: series, scales, and truncated or damaged logs."""

from made_logs import copter, Dataflash, load, named, outcomes_of_flipped_bytes
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.dataflash import _cells
import pytest


@pytest.mark.parametrize('form', ['dataflash', 'dataflash_text'])
def test_binary_and_text_logs_are_read_exactly(tmp_path, form):
    made, t, volts, share, amperes, pulses = copter()
    path, log = load(tmp_path, made.binary if form == 'dataflash' else made.text)
    chosen = choose(path, log)
    assert log.format == form and log.notes == ()
    assert log.facts == {'firmware': 'ArduCopter V4.5.1 (abcd1234)',
                         'vehicle': 'CubeOrange 00380038 3533510A 38373438'}
    assert (chosen.voltage.name, chosen.throttle.name, chosen.current.name) == (
        'BAT[0].Volt', 'CTUN.ThO', 'BAT[0].Curr')
    np.testing.assert_array_equal(chosen.voltage.values, volts[0].astype(float))
    np.testing.assert_array_equal(chosen.throttle.values, share.astype(float))
    np.testing.assert_array_equal(chosen.current.values, amperes.astype(float))
    np.testing.assert_allclose(chosen.voltage.t, t, rtol=0, atol=1e-9)
    np.testing.assert_allclose(chosen.throttle.t, t + 5e-4, rtol=0, atol=1e-9)
    assert any('POWR.Vcc (5 V rail)' in note and 'POWR.VServo' in note for note in chosen.notes)
    # The outputs that the parameters call motors, on the span that they state.
    motors = named(log)['RCOU.motors']
    np.testing.assert_allclose(
        motors.values, ((pulses[:, :2] - 1100) / 800).mean(axis=1), rtol=1e-12)


def test_progress_is_told_while_a_log_is_read(tmp_path):
    shares = []
    load(tmp_path, copter(1100)[0].binary, progress=shares.append)
    assert shares and shares == sorted(shares) and 0.0 < shares[-1] <= 1.0


def test_the_rail_by_name(tmp_path):
    """The 5 V rail is there for who asks for it; the battery's current goes with it."""
    path, log = load(tmp_path, copter()[0].binary)
    chosen = choose(path, log, voltage='POWR.Vcc', throttle='RCOU.C3')
    assert chosen.voltage.words == '5 V rail' and set(chosen.voltage.values) == {5.0}
    assert chosen.current.name == 'BAT[0].Curr'
    assert chosen.throttle.name == 'RCOU.C3'


def test_two_batteries_need_a_choice(tmp_path):
    """Instances are read separately, and the user must choose."""
    made, _, volts, *_ = copter(batteries=2)
    path, log = load(tmp_path, made.binary)
    with pytest.raises(InputError, match=r'BAT\[0\].Volt.*BAT\[1\].Volt.*--voltage'):
        choose(path, log)
    chosen = choose(path, log, voltage='BAT[1].Volt')
    np.testing.assert_array_equal(chosen.voltage.values, volts[1].astype(float))
    assert chosen.current.name == 'BAT[1].Curr'


@pytest.mark.parametrize('factor', [1.0, 100.0, 1000.0])
def test_scales_of_the_throttle(tmp_path, factor):
    """A share, percent and thousandths all become 0..1."""
    made, _, _, share, *_ = copter(throttle_factor=factor)
    path, log = load(tmp_path, made.binary)
    throttle = choose(path, log).throttle
    np.testing.assert_allclose(throttle.values, share, rtol=1e-6)
    assert float(throttle.scale) == 1.0 / factor


def test_outputs_without_parameters(tmp_path):
    _, log = load(tmp_path, copter(parameters=False)[0].binary)
    assert 'RCOU.motors' not in named(log)
    assert named(log)['RCOU.C1'].rank is None


def test_units_of_old_logs_are_converted(tmp_path):
    """Milliseconds, and hundredths of a volt in whole numbers (CURR of 2013)."""
    log = Dataflash()
    log.form(9, 'CURR', 'IhIhhhf', 'TimeMS,ThrOut,ThrInt,Volt,Curr,Vcc,CurrTot')
    for k in range(50):
        log.put('CURR', 1000 + 100 * k, 400, 0, 1100 + k, 250, 4900, 1.0)
    path, found = load(tmp_path, log.binary)
    chosen = choose(path, found)
    np.testing.assert_allclose(chosen.voltage.values, 11.0 + 0.01 * np.arange(50), rtol=1e-12)
    np.testing.assert_allclose(chosen.current.values, 2.5)
    np.testing.assert_allclose(chosen.voltage.t, 0.1 * np.arange(50), atol=1e-9)
    rail = choose(path, found, voltage='CURR.Vcc').voltage
    np.testing.assert_allclose(rail.values, 4.9, rtol=1e-6)


def test_a_log_without_a_battery_names_the_missing_messages(tmp_path):
    log = Dataflash()
    log.form(1, 'MSG', 'QZ', 'TimeUS,Message')
    log.put('MSG', 1, 'ArduCopter V4.5.1')
    with pytest.raises(InputError, match='none of the messages.*BAT'):
        load(tmp_path, log.binary)


def test_a_truncated_log_is_read_up_to_its_end(tmp_path):
    made, _, volts, *_ = copter(40)
    ends = np.cumsum([len(piece) for piece in made.pieces])
    first = int(ends[-60])
    rng = np.random.default_rng(8)
    for at in rng.integers(first, len(made.binary), 40).tolist():
        path, log = load(tmp_path, made.binary[:at])
        chosen = choose(path, log)
        np.testing.assert_array_equal(
            chosen.voltage.values, volts[0, :chosen.voltage.n].astype(float))
        if at not in ends:
            held = int(ends[np.searchsorted(ends, at) - 1])
            assert log.notes == (
                f'{at - held} of {at} bytes belong to no message, so the log is cut off at byte '
                f'{held}; the other messages were read.',)
        else:
            assert log.notes == ()


def test_erased_page_is_not_damage(tmp_path):
    _, log = load(tmp_path, copter(30)[0].binary + b'\xff' * 200)
    assert log.notes == ()


@pytest.mark.parametrize('form', ['binary', 'text'])
def test_flipped_bytes_give_an_error_or_a_note(tmp_path, form):
    whole = getattr(copter(60)[0], form)
    first = 3 if form == 'text' else whole.index(b'ArduCopter') // 2
    refused, mended = outcomes_of_flipped_bytes(tmp_path, whole, first, 9, 50)
    assert mended and (refused or form == 'binary')


def test_text_log_with_binary_bytes(tmp_path):
    text = copter(30)[0].text
    at = text.index(b'BAT, ', len(text) // 2)
    path, log = load(tmp_path, text[:at] + b'\xfe\xff' + text[at + 2:], 'a.log')
    assert choose(path, log).voltage.n == 29
    assert log.notes == ('2 bytes beyond ASCII read as "?".',
                         'Left out: 1 line not in any format of this log.')


def test_messages_of_the_parser_are_suppressed(tmp_path, capfd):
    """Nothing that it prints about damaged bytes appears, also not from C."""
    whole = copter(30)[0].binary
    load(tmp_path, whole[:3000] + bytes(400) + whole[3000:])
    assert capfd.readouterr() == ('', '')


def test_a_text_log_cut_off(tmp_path):
    text = copter(30)[0].text
    path, log = load(tmp_path, text[:-7], 'a.log')
    assert log.notes == (
        'Left out: 1 line not in any format of this log.',
        f'The last line does not end: the log was cut off at byte {len(text) - 7}.')
    assert choose(path, log).voltage.n == 30


@pytest.mark.parametrize('kind, columns, name', [
    ('CURR', 'TimeMS,ThrOut,ThrInt,Volt,Curr,Vcc,CurrTot', 'CURR.ThrOut'),
    ('CURR', 'TimeMS,Throttle,ThrInt,Volt,Curr,Vcc,CurrTot', 'CURR.Throttle'),
    ('CTUN', 'TimeMS,ThrOut,ThrInt,Volt,Curr,Vcc,CurrTot', 'CTUN.ThrOut')])
def test_throttle_of_copters_until_2015(tmp_path, kind, columns, name):
    """Thousandths, under the names that it had; CTUN goes first, as it is logged more often."""
    log = Dataflash()
    log.form(9, 'CURR', 'IhIhhhf', columns if kind == 'CURR' else columns.replace('ThrOut', 'X'))
    if kind == 'CTUN':
        log.form(10, 'CTUN', 'IhhhI', 'TimeMS,ThrIn,AngBst,ThrOut,X')
    for k in range(50):
        log.put('CURR', 1000 + 100 * k, 350 + k, 0, 1100 + k, 250, 4900, 1.0)
        if kind == 'CTUN':
            log.put('CTUN', 1000 + 100 * k, 900, 0, 350 + k, 0)
    path, found = load(tmp_path, log.binary)
    throttle = choose(path, found).throttle
    assert throttle.name == name
    np.testing.assert_allclose(throttle.values, (350 + np.arange(50)) / 1000.0)


@pytest.mark.parametrize('stated, found', [
    ({'BATT_CAPACITY': 3700.0}, {'capacity_mah': '3700'}), ({'BATT_CAPACITY': 3300.0}, {}),
    ({'BATT_CAPACITY': 0.0}, {}), ({'MOT_BAT_VOLT_MAX': 16.8}, {'cells': '4'}),
    ({'MOT_BAT_VOLT_MAX': 16.8, 'BATT_CAPACITY': 1500.0},
     {'capacity_mah': '1500', 'cells': '4'})])
def test_the_pack_of_the_parameters(stated, found):
    """The default capacity, 3300 mAh, is no statement."""
    assert _cells(stated) == found
