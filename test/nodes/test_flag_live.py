"""The flag of a real estimator: floor, latch and its service, parameters, model file."""

import math

from live import Estimator, ou_path, wait_until
import pytest
from rcl_interfaces.srv import GetParameters
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

ERROR, STALE = b'\x02', b'\x03'
DT = 0.002
MODEL = """\
model:
- term: ou
  params: {alpha: 63.0, sigma: 0.3, u0: 5.0}
- term: measurement_noise
  params: {std: 0.002}
"""


class Rig(Estimator):
    """An estimator whose throttle budget is heard too."""

    def __init__(self, world, namespace):
        super().__init__(world, namespace)
        self.budgets = self.probe.listen(f'{self.node}/throttle_budget', Float64)
        self.connect(BatteryState)

    def feed(self, voltages):
        """Send samples 2 ms apart."""
        super().feed(voltages, DT)

    def wait_level(self, level):
        wait_until(lambda: self.field('brownout_level') == level, what=f'the level {level}')

    def get(self, name):
        answer = self.probe.call(GetParameters, f'{self.node}/get_parameters',
                                 GetParameters.Request(names=[name]))
        return answer.values[0]

    def give(self, name, value):
        result = self.probe.set_parameter(self.node, name, value)
        assert result.successful, result.reason

    def clear(self):
        return self.probe.call(Trigger, f'{self.node}/clear_brownout', Trigger.Request())


@pytest.fixture(scope='module')
def rig(shared_world):
    return Rig(shared_world, 'flag')


def test_no_flag_is_published_while_unknown(rig):
    """Three samples make no estimate: no flag is published, neither true nor false."""
    rig.feed([5.0, 5.01, 4.99])
    wait_until(lambda: int(rig.field('pushed')) >= 1)
    states = len(rig.states)
    wait_until(lambda: len(rig.states) > states + 3)
    assert rig.flags == [] and rig.field('brownout') == 'unknown'
    assert rig.field('brownout_level') == 'UNKNOWN'
    assert rig.budgets and all(math.isnan(m.data) for m in rig.budgets)
    assert rig.field('throttle_budget') == 'nan'
    answer = rig.clear()
    assert not answer.success and 'Nothing to clear' in answer.message


def test_the_floor_sets_the_latch_and_the_service_clears_it(rig):
    # 50 ms below the floor, of which best effort may lose some.
    rig.give('brownout.latch', True)
    rig.give('brownout.hold', 0.0)
    rig.feed(ou_path(500, DT, seed=1))
    wait_until(lambda: False in [m.data for m in rig.flags], what='a flag that says false')
    rig.feed([4.2] * 25 + ou_path(25, DT, seed=2))
    rig.wait_level('CRITICAL')
    wait_until(lambda: rig.flags[-1].data, what='the flag')
    # A window later the dip is forgotten, the latch is not.
    rig.feed(ou_path(1500, DT, seed=3))
    wait_until(lambda: 'latched' in rig.field('brownout_reason'), what='the latch')
    assert rig.status.level in (ERROR, STALE) and rig.flags[-1].data
    # Nor does silence end it.
    wait_until(lambda: rig.status.level == STALE, what='STALE')
    states = len(rig.states)
    wait_until(lambda: len(rig.states) > states + 3)
    assert rig.field('brownout_level') == 'CRITICAL'
    answer = rig.clear()
    assert answer.success and 'CRITICAL of' in answer.message
    rig.wait_level('UNKNOWN')
    flags = len(rig.flags)
    states = len(rig.states)
    wait_until(lambda: len(rig.states) > states + 3)
    assert len(rig.flags) <= flags + 1 and rig.field('brownout') == 'unknown'


def test_a_bad_model_file_leaves_the_old_one(rig, shared_world):
    good, bad = shared_world.folder / 'good.yaml', shared_world.folder / 'bad.yaml'
    good.write_text(MODEL)
    bad.write_text(MODEL.replace('measurement_noise', 'measurment_noise'))
    resets = rig.field('resets')
    rig.give('model_file', str(good))
    wait_until(lambda: rig.field('model_terms') == 'ou,measurement_noise', what='the terms')
    # Of throttle it says nothing, nor has this flight.
    assert rig.field('model_verdict') == 'CANNOT_TELL'
    answer = rig.probe.call(Trigger, f'{rig.node}/save_model', Trigger.Request())
    assert not answer.success and answer.message.startswith('Nothing to save')
    assert good.read_text() == MODEL
    result = rig.probe.set_parameter(rig.node, 'model_file', str(bad))
    assert not result.successful and "did you mean 'measurement_noise'" in result.reason
    assert rig.get('model_file').string_value == str(good)
    # The file in use may go away: other parameters can still be set.
    good.unlink()
    rig.give('brownout.warn', 0.02)
    states = len(rig.states)
    wait_until(lambda: len(rig.states) > states + 2)
    assert rig.field('model_terms') == 'ou,measurement_noise'
    rig.give('model_file', '')
    wait_until(lambda: rig.field('model_terms') == '', what='no terms')
    assert rig.field('resets') == resets
