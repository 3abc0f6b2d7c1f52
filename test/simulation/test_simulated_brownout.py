"""The closed loop: a simulated supply into the monitor; an old pack browns out, a good one not."""

from live import ROOT
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.recordings.model_file import read_model
from ou_monitor.simulation import read_profile, simulated
import pytest

# 3.3 V a cell.
LIMIT = 13.2


def flown(resistance, seed, duration=40.0, rate=100.0, look=0.1):
    """Return stamps of the reports, s, lowest voltage before each since the last, and its flag."""
    monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=LIMIT))
    (piece,) = simulated(
        read_model(ROOT / 'models' / 'gecko.yaml').model, read_profile('flight'),
        duration=duration, rate=rate, seed=seed, charge=np.nan, resistance=resistance)
    each, levels = round(look * rate), []
    for k in range(0, piece.n, each):
        part = slice(k, k + each)
        monitor.push(piece.t[part], piece.voltage[part], piece.throttle[part])
        levels.append(monitor.report(0.0).flag.level is FlagLevel.CRITICAL)
    # The floor takes the median of three readings: a lone one is no dip.
    middle = np.median(np.lib.stride_tricks.sliding_window_view(
        np.concatenate((piece.voltage[:1], piece.voltage, piece.voltage[-1:])), 3), axis=1)
    return piece.t[each - 1::each], middle.reshape(-1, each).min(axis=1), np.array(levels)


def test_a_good_pack_sets_no_flag():
    """Not once in two flights; an hour of them is in the benchmark."""
    for seed in range(2):
        _, low, critical = flown(1.0, seed)
        assert low.min() > LIMIT and not critical.any()


@pytest.mark.parametrize('seed', [0, 1])
def test_an_old_pack_is_flagged_before_or_at_the_dip(seed):
    """The report of the samples in which it begins says CRITICAL, at the latest."""
    _, low, critical = flown(1.8, seed)
    below = low <= LIMIT
    begins = np.flatnonzero(below & ~np.append(False, below[:-1]))
    assert begins.size and critical[begins].all()
