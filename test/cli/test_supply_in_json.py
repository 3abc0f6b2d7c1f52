"""One set of supply facts: two commands, a row of the fleet and the node give equal numbers."""

import math

from command_line import answer
import numpy as np
from ou_monitor import MonitorSettings, read_recording, SupplyMonitor
from ou_monitor.fleet.analysis import Options, work
from project import REAL, ROOT
import pytest

# Recording, limit in V, and the part of it that is taken, s.
RECORDINGS = [
    (ROOT / 'bags/recorded/gecko_gyro.csv', 15.5, (0, 6)),
    (ROOT / 'bags/recorded/micromouse', 3.5, (0, 10)),
    (ROOT / 'bags/flight', 4.7, (0, 3)),
    *((REAL / f'{name}.csv', limit, part) for name, limit, part in (
        ('as_f60', 14.5, (0, 20)), ('bf_gecko_a', 14.0, (20, 40)), ('cf_bl00', 3.6, (0, 20)),
        ('cf_solo_large', 3.6, (0, 20)), ('euc_1', 60.0, (0, 60)), ('frc_ol_1', 11.0, (20, 60)),
        ('hebi_x', 46.0, (0, 20)), ('js_11t_6s', 20.0, (0, 60)), ('regbot_81', 11.0, (0, 1))))]


def part_of(path, part, folder):
    """Return the path of a part of a recording, as a table, and the recording read from there."""
    whole = read_recording(path)
    here = slice(*np.searchsorted(whole.t - whole.t[0], part))
    columns = {'time_s': whole.t[here], 'voltage_v': whole.voltage[here]}
    if whole.has_throttle:
        columns['throttle'] = whole.throttle[here]
    if whole.current is not None:
        columns['current_a'] = whole.current[here]
    table = folder / f'{path.stem}_part.csv'
    np.savetxt(table, np.stack(list(columns.values()), axis=1), '%.17g', ',',
               header=','.join(columns), comments='')
    return table, read_recording(table)


@pytest.mark.parametrize('name, limit, end, command, more', [
    ('flight', 4.6, 3, 'discover', ()),
    ('recorded/gecko_gyro.csv', 15.5, 6, 'coupling', ('--signal', 'gyro_x_deg_s'))])
def test_a_command_gives_the_object_of_analyze(name, limit, end, command, more, capsys):
    part = ROOT / 'bags' / name, '--brownout-voltage', limit, '--from', 0, '--to', end
    supply = answer(capsys, 'analyze', *part)['supply']
    assert answer(capsys, command, *part, *more)['supply'] == supply
    assert supply['dips']['limit_v'] == limit and supply['budget']['throttle'] > 0.0


def near(found, wanted, tolerance=0.0):
    """Whether two values or lists are the same, null among them."""
    return np.allclose(np.array(found, dtype=float), np.array(wanted, dtype=float), tolerance,
                       tolerance, equal_nan=True)


@pytest.mark.parametrize('path, limit, part', RECORDINGS, ids=lambda x: getattr(x, 'stem', ''))
def test_commands_fleet_and_node_agree_on_the_facts(path, limit, part, tmp_path, capsys):
    if not path.exists():
        pytest.skip('OU_MONITOR_REALDATA is not set')
    table, recording = part_of(path, part, tmp_path)
    given = table, '--brownout-voltage', limit
    analysis = answer(capsys, 'analyze', *given)
    supply = analysis['supply']
    assert answer(capsys, 'compare', *given, '--seeds', 20)['supply'] == supply
    row = work(str(table), Options(brownout_voltage=limit))
    assert row['supply'] == supply
    for column, wanted in (
            ('lowest', supply['lowest']['voltage_v']), ('lowest_at', supply['lowest']['time_s']),
            ('lowest_throttle', supply['lowest']['throttle']), ('dips', supply['dips']['count']),
            ('below_s', supply['dips']['seconds'])):
        assert near(row[column], wanted), column
    sag = supply['sag']
    if sag['known']:
        assert near(row['sag_full'], sag['sag_v'][-1])
    # The node at the end.
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=limit))
    monitor.push(recording.t, recording.voltage,
                 recording.throttle if recording.has_throttle else None,
                 current=recording.current)
    report = monitor.report(0.0)
    assert near(report.load.sag(sag['throttle']), sag['sag_v'], 1e-9)
    assert near(report.load.resistance, supply['resistance']['ohm'], 1e-9)
    assert near(report.budget, supply['budget']['throttle'], 1e-9)
    for name, value in supply['ou'].items():
        found = getattr(report.ou, name)
        assert found == value if name == 'status' else near(found, value, 1e-6), name
    assert near(analysis['brownout']['throttle_budget'], report.budget, 1e-9)
    # A relaxation that most of the recording shows is that of its end, by both intervals.
    ou = supply['ou']
    for level in analysis['levels']:
        if level['alpha'] is None or ou['alpha'] is None or (
                level['time_s'] < 0.5 * recording.duration):
            continue
        low, high = level['alpha_ci95']
        assert low < ou['alpha_95'][1] and high > ou['alpha_95'][0]
        assert math.isclose(level['var_inf'], level['sigma'] ** 2 / (2.0 * level['alpha']),
                            rel_tol=0.1)
