"""security/ou_monitor_policy.xml: valid for SROS2, with exactly the topics of the nodes."""

import time
import xml.etree.ElementTree as ElementTree

from live import wait_until
from made_devices import attributes
from project import ROOT
import pytest

FILE = ROOT / 'security' / 'ou_monitor_policy.xml'
# Where a node says what it has opened.
ASK = {'publish': 'get_publisher_names_and_types_by_node',
       'subscribe': 'get_subscriber_names_and_types_by_node',
       'reply': 'get_service_names_and_types_by_node'}
# What only managed nodes open.
LIFECYCLE = ('change_state', 'get_state', 'get_available_states', 'get_available_transitions',
             'get_transition_graph', 'transition_event')
INPUTS = {'estimator': (('/voltage', '/throttle'), []),
          'adaptive_filter': (('/input', '/throttle', '/rpm'), [
              '-p', 'notch.count:=4', '-r', 'sigma:=ou_estimator/sigma',
              '-r', 'state:=ou_estimator/state'])}


def policy() -> ElementTree.Element:
    return ElementTree.parse(FILE).getroot()


def allowed(executable: str) -> dict[str, set[str]]:
    """Return the full names that an executable may publish, subscribe, reply and request."""
    (profile,) = policy().iterfind(f'.//enclave[@path="/ou_monitor/{executable}"]//profile')
    names: dict[str, set[str]] = {}
    for group in profile:
        ((verb, rule),) = group.attrib.items()
        assert rule == 'ALLOW' and verb not in names
        space, node = profile.get('ns', '').rstrip('/'), profile.get('node')
        # As SROS2's permissions.xsl makes full names.
        listed = [item.text if item.text.startswith('/') else f'{space}/{node}{item.text[1:]}'
                  if item.text.startswith('~') else f'{space}/{item.text}' for item in group]
        assert len(listed) == len(set(listed))
        names[verb] = set(listed)
    return names


def test_the_form_is_that_of_sros2():
    """Version and elements are those of the schema; each enclave is there once."""
    root = policy()
    assert root.tag == 'policy' and root.get('version') == '0.2.0'
    assert {element.tag for element in root.iter()} == {
        'policy', 'enclaves', 'enclave', 'profiles', 'profile', 'topics', 'services', 'topic',
        'service'}
    paths = [enclave.get('path') for enclave in root.iter('enclave')]
    names = ['estimator', 'adaptive_filter', 'adc', 'replay', 'live', 'operator']
    assert paths == [f'/ou_monitor/{name}' for name in names] and all(map(allowed, names))


def opened(probe, node: str) -> dict[str, set[str]]:
    """Return the full names that a node has opened."""
    from rclpy.node import NodeNameNonExistentError
    try:
        return {verb: {name for name, _ in getattr(probe.node, method)(node, '/')}
                for verb, method in ASK.items()}
    except NodeNameNonExistentError:
        return dict.fromkeys(ASK, set())


def compare(probe, executable: str, node: str, managed: bool = False) -> None:
    """Wait until a node has opened what the policy allows, and nothing else."""
    wanted = allowed(executable)
    wanted.setdefault('subscribe', set())
    if not managed:
        wanted = {verb: names - {f'/{node}/{own}' for own in LIFECYCLE}
                  for verb, names in wanted.items()}
    wait_until(lambda: all(wanted[verb] <= names for verb, names in opened(probe, node).items()),
               what=f'{node} to open {wanted}; it has {opened(probe, node)}')
    # What would come later is no part of the policy either.
    time.sleep(0.5)
    assert opened(probe, node) == wanted, 'change security/ou_monitor_policy.xml with the node'


@pytest.mark.parametrize('name, managed', [
    ('estimator', False), ('estimator', True), ('adaptive_filter', True)])
def test_a_node_opens_what_the_policy_allows(world, name, managed):
    """With all inputs found, wired as the launch file does, and time from /clock; when active."""
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState
    from std_msgs.msg import Float32
    topics, options = INPUTS[name]
    world.start(name, *['--lifecycle'] * managed, '--ros-args', '-p', 'use_sim_time:=true',
                *options)
    probe = world.probe()
    outputs = [probe.publisher(topic, Float32) for topic in topics]
    for step in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE) * managed:
        assert probe.call(ChangeState, f'/ou_{name}/change_state', ChangeState.Request(
            transition=Transition(id=step))).success
    compare(probe, name, f'ou_{name}', managed)
    assert len(outputs) == len(topics)


def test_replay_opens_what_the_policy_allows(world):
    """A bag with voltage and throttle, and the clock."""
    world.start('replay', str(ROOT / 'bags' / 'flight'), '--loop', '--rate', '0.5')
    compare(world.probe(), 'replay', 'ou_replay')


def test_the_adc_opens_what_the_policy_allows(world, tmp_path):
    """Its parameters are read once, so nobody need set them."""
    attributes(tmp_path / 'sys/class/hwmon/hwmon0', name='ina226', in1_input=5000)
    world.start('adc', '--ros-args', '-p', 'device:=ina226', '-p', f'sysfs:={tmp_path}/sys')
    compare(world.probe(), 'adc', 'ou_adc')


def test_only_the_operator_may_call():
    """It may set the parameters of both nodes and clear the latch; they may call nobody."""
    operator = allowed('operator')
    for name in ('estimator', 'adaptive_filter', 'replay'):
        assert 'request' not in allowed(name)
        served = {service for service in allowed(name)['reply']
                  if not service.endswith('get_type_description')}
        assert served <= operator['request']
    assert operator['subscribe'] <= {'/clock'} | allowed('estimator')['publish'] | allowed(
        'adaptive_filter')['publish']
