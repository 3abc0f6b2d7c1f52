"""The number of files of the package between a voltage message and a report."""

import math
from pathlib import Path
import sys

import numpy as np
import ou_monitor
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Status
from ou_monitor.stream.config import FieldSpec
from ou_monitor.stream.samples import SampleStream
import pytest

ROOT = str(Path(ou_monitor.__file__).parent)
MOST = 24


def files_of(calls):
    """Return the files of the package in which the calls run any line."""
    found = set()

    def note(frame, event, arg):
        if frame.f_code.co_filename.startswith(ROOT):
            found.add(frame.f_code.co_filename[len(ROOT) + 1:])

    before = sys.getprofile()
    sys.setprofile(note)
    try:
        calls()
    finally:
        sys.setprofile(before)
    return found


@pytest.mark.parametrize('moving', [False, True])
def test_one_voltage_message_to_one_report(moving):
    rng = np.random.default_rng(1)
    monitor = SupplyMonitor(MonitorSettings(brownout_voltage=4.5, brownout_horizon=1.0))
    stream = SampleStream(monitor)
    stream.open_voltage(FieldSpec('voltage', 'x/msg/X', 'data'))
    stream.open_throttle(FieldSpec('throttle', 'x/msg/X', 'data'))
    away, passed = 0.0, []
    for k in range(6000):
        t = 1e-3 * k
        throttle = 0.5 + 0.3 * math.sin(2.0 * t) * moving
        away = away * math.exp(-0.063) + 0.0187 * rng.standard_normal()
        voltages = (np.array([t]), np.zeros(1, bool), np.ones(1, int),
                    np.array([5.0 - 0.3 * throttle + away]))
        if k % 20 == 0:
            stream.add_throttle(t, False, throttle)
        if k % 100 or k < 5000:
            stream.take_voltages(*voltages)
            if k % 100 == 0:
                stream.flush()
                monitor.report(0.0)
            continue
        reports = []

        def pass_on(voltages=voltages, reports=reports):
            stream.take_voltages(*voltages)
            stream.flush()
            reports.append(monitor.report(0.0))

        passed.append(files_of(pass_on))
        # All of it is known but the budget of a throttle that stands still: nothing was left out.
        assert reports[0].estimate.status is Status.OK
        assert math.isfinite(reports[0].risk) and math.isfinite(reports[0].budget) == moving
    # One more is the module of the node whose callback it is.
    assert all(len(files) + 1 <= MOST for files in passed), passed
