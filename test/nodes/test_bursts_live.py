"""Messages without stamps, in bursts, over DDS: reported, and not used for an estimate."""

import time

from diagnostic_msgs.msg import DiagnosticArray
from live import ou_path, values_of, wait_until
from std_msgs.msg import Float64


def test_bursts_are_reported(world):
    """1 kHz in bursts of 50, whose times of sending would give an alpha of 555 for 63."""
    probe = world.probe()
    states = probe.listen('/ou_estimator/state', DiagnosticArray)
    sender = probe.publisher('/voltage', Float64, 1000)
    process = world.start('estimator', '--ros-args', '-p', 'window:=4.0')
    wait_until(lambda: 'voltage from' in process.err, what='subscription')
    wait_until(sender.get_subscription_count)
    path = ou_path(12_000, 0.001, seed=5)
    begin = time.monotonic()
    for k in range(0, len(path), 50):
        time.sleep(max(begin + 0.001 * (k + 50) - time.monotonic(), 0.0))
        for u in path[k:k + 50]:
            sender.publish(Float64(data=u))
        if states and 'in bursts' in states[-1].status[0].message:
            break
    assert 'in bursts' in states[-1].status[0].message
    fields = values_of(states[-1].status[0])
    assert fields['alpha'] == fields['smoothed_rate'] == 'nan'
    assert process.stop() == 0
