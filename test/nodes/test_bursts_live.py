"""Messages without stamps, in bursts, over DDS: what they were samples of is recovered."""

import time

from diagnostic_msgs.msg import DiagnosticArray
from live import ou_path, values_of, wait_until
import pytest
from std_msgs.msg import Float64


def test_alpha_and_sigma_through_bursts(world):
    """1 kHz in bursts of 50: told at first, then alpha of 63 (555 by the times of sending)."""
    probe = world.probe()
    states = probe.listen('/ou_estimator/state', DiagnosticArray)
    sender = probe.publisher('/voltage', Float64, 1000)
    process = world.start('estimator', '--ros-args', '-p', 'window:=4.0')
    wait_until(lambda: 'voltage from' in process.err, what='subscription')
    wait_until(sender.get_subscription_count)
    path = ou_path(12_000, 0.001, seed=5)
    begin = time.monotonic()
    fields = {}
    for k in range(0, len(path), 50):
        time.sleep(max(begin + 0.001 * (k + 50) - time.monotonic(), 0.0))
        for u in path[k:k + 50]:
            sender.publish(Float64(data=u))
        fields = values_of(states[-1].status[0]) if states else {}
        if float(fields.get('duration', 0.0)) > 3.9 and fields['status'] == 'OK':
            break
    assert any('in bursts' in state.status[0].message for state in states)
    # Eight standard errors of ln alpha of 4 s of a relaxation of 16 ms: 0.09 each.
    assert fields['status'] == 'OK', states[-1].status[0].message
    assert float(fields['alpha']) == pytest.approx(63.0, rel=0.7)
    assert float(fields['sigma']) == pytest.approx(0.3, rel=0.2)
    assert float(fields['smoothed_rate']) == pytest.approx(1000.0, rel=0.05)
    assert process.stop() == 0
