"""Notches in the node: motor speeds from any field, throttle, lag, and switching off."""

import time

from live import LowPass, to_stamp, values_of, wait_until
import numpy as np
from ou_monitor.online.filter.filter_state import phase_lag
import pytest
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Float32

LINE = 250.0


class Rig(LowPass):
    """The filter with four notches, a gyro with a line, and eRPM in a field of an odd type."""

    def __init__(self, world):
        super().__init__(
            world, {'rpm': JointState, 'throttle': Float32}, '-p', 'notch.count:=4', '-p',
            'notch.rpm_unit:=erpm', '-p', 'notch.poles:=14', '-p',
            'rpm.type:=sensor_msgs/msg/JointState', '-p', 'rpm.field:=velocity[]')
        self.rng = np.random.default_rng(1)
        self.sent = 0

    def fly(self, samples, rpm=True):
        """Send samples of a line in noise, 1 kHz by their stamps, faster than they are flown."""
        for _ in range(samples):
            t = 100.0 + 1e-3 * self.sent
            if self.sent % 20 == 0:
                self.inputs['throttle'].publish(Float32(data=0.5))
                if rpm:
                    self.inputs['rpm'].publish(JointState(velocity=[60.0 * 7.0 * LINE] * 2))
                time.sleep(0.008)
            message = Imu()
            message.header.stamp = to_stamp(t)
            gyro = message.angular_velocity
            gyro.x = 5.0 * np.sin(2 * np.pi * LINE * t) + 0.1 * self.rng.standard_normal()
            self.inputs['input'].publish(message)
            self.sent += 1

    @property
    def said(self):
        return {} if self.status is None else values_of(self.status)


@pytest.fixture(scope='module')
def rig(shared_world):
    return Rig(shared_world)


def test_rpm_of_any_field_sets_the_notches(rig):
    """They stand where the motors are, and their lag is told with that of the low-pass."""
    def there():
        rig.fly(200)
        said = rig.said
        words = said.get('notch_frequencies', '').split(', ')
        if said.get('notch_source') != 'rpm' or words == ['']:
            return False
        assert [float(word) for word in words] == pytest.approx([LINE] * len(words), rel=0.01)
        alone = phase_lag(2, rig.cutoff[-1].data, 10.0) / 3600.0
        return (said['notch_active'] == 'True' and float(said['rpm_age']) < 1.0
                and rig.lag[-1].data > 1e3 * alone + 0.05
                and rig.lag[-1].data == pytest.approx(1e3 * float(said['delay']), rel=0.05))
    wait_until(there, what='notches by rpm, and their lag')


def test_a_bad_unit_is_refused_and_none_is_accepted(rig):
    refused = rig.set('notch.poles', 0)
    assert not refused.successful and 'notch.poles' in refused.reason
    assert rig.set('notch.count', 0).successful

    def faded():
        rig.fly(200)
        alone = phase_lag(2, rig.cutoff[-1].data, 10.0) / 3600.0
        return rig.lag[-1].data == pytest.approx(1e3 * alone, rel=1e-3)
    wait_until(faded, what='the lag of the low-pass alone')
