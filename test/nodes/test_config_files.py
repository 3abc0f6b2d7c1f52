"""The shipped parameter, launch, layout and policy files agree with the program."""

import ast
from importlib import import_module
import json
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time
from types import ModuleType
import xml.etree.ElementTree as ElementTree

from live import wait_until
from made_devices import attributes
from ou_monitor.nodes.adaptive_filter_node import AdaptiveFilterNode
from ou_monitor.nodes.adc_node import AdcNode
from ou_monitor.nodes.base import LOCK
from ou_monitor.nodes.estimator_node import EstimatorNode
from ou_monitor.nodes.supply_simulator_node import SupplySimulatorNode
from ou_monitor.stream.config import list_msg_configs, parse_field_path
from project import metadata, ROOT
import pytest
import rclpy
import yaml

NODES = {'ou_estimator': EstimatorNode, 'ou_adaptive_filter': AdaptiveFilterNode}
FILE = ROOT / 'config' / 'ou_monitor.yaml'
ADC_FILE = ROOT / 'config' / 'adc.yaml'
LAUNCH = ROOT / 'launch' / 'ou_monitor_launch.py'
SIMULATED = ROOT / 'launch' / 'ou_monitor_simulated_launch.py'
TWO = ROOT / 'launch' / 'ou_monitor_two_batteries_launch.py'


def flat(group, prefix=''):
    """Return nested keys as dotted names."""
    found = {}
    for key, value in group.items():
        if isinstance(value, dict):
            found.update(flat(value, f'{prefix}{key}.'))
        else:
            found[prefix + key] = value
    return found


@pytest.mark.parametrize('file, kinds', [(FILE, list(NODES.values())), (ADC_FILE, [AdcNode])])
def test_every_parameter_at_its_default(file, kinds):
    """No key that is not declared, none missing, same value, same type."""
    content = yaml.safe_load(file.read_text())
    for kind, group in zip(kinds, content.values(), strict=True):
        listed = flat(group['ros__parameters'])
        defaults = {p.name: p.default for p in (*kind.RUN_TIME, *kind.FIXED, LOCK)}
        assert listed == defaults
        assert {k: type(v) for k, v in listed.items()} == {
            k: type(v) for k, v in defaults.items()}


@pytest.mark.parametrize('file', [FILE, ADC_FILE])
def test_every_key_has_a_comment(file):
    lines = file.read_text().splitlines()
    for above, line in zip(lines, lines[1:]):
        if re.match(r' {4,}\w+: \S', line):
            assert above.strip().startswith('#'), line


class Call:
    """Stands for a class of launch; remembers how it was made."""

    def __init__(self, *args, **kwargs):
        self.args, self.kwargs = args, kwargs

    def __eq__(self, other):
        return (self.args, self.kwargs) == (other.args, other.kwargs)


@pytest.fixture(params=[LAUNCH])
def described(request, monkeypatch):
    """Give what the launch file describes, made with stand-ins of the launch package."""
    kinds = {'launch': ['LaunchDescription'],
             'launch.actions': ['DeclareLaunchArgument', 'SetEnvironmentVariable',
                                'OpaqueFunction', 'GroupAction', 'IncludeLaunchDescription'],
             'launch.conditions': ['IfCondition'],
             'launch.launch_description_sources': ['PythonLaunchDescriptionSource'],
             'launch.substitutions': ['EnvironmentVariable', 'LaunchConfiguration'],
             'launch_ros': [],
             'launch_ros.actions': ['Node'],
             'launch_ros.parameter_descriptions': ['ParameterValue']}
    for module, classes in kinds.items():
        stand_in = ModuleType(module)
        for name in classes:
            setattr(stand_in, name, type(name, (Call,), {}))
        monkeypatch.setitem(sys.modules, module, stand_in)
    path = request.param
    space = {'__file__': str(path), '__name__': 'launch_file'}
    exec(compile(path.read_text(), str(path), 'exec'), space)
    return space['generate_launch_description']().args[0]


def of_kind(described, kind):
    return [entry for entry in described if type(entry).__name__ == kind]


def test_launch_takes_namespace_parameters_and_clock(described):
    arguments = {a.args[0]: a.kwargs['default_value']
                 for a in of_kind(described, 'DeclareLaunchArgument')}
    network = arguments.pop('discovery_range')
    assert arguments == {
        'namespace': '', 'params_file': str(FILE), 'use_sim_time': 'false', 'voltage': 'voltage',
        'throttle': 'throttle', 'input': 'input', 'filter': 'true', 'respawn': 'false',
        'log_level': 'info'}
    assert type(network).__name__ == 'EnvironmentVariable'
    assert network.args == ('ROS_AUTOMATIC_DISCOVERY_RANGE',)
    assert network.kwargs == {'default_value': 'LOCALHOST'}


def test_the_nodes_are_found_on_this_machine_alone(described):
    """Before they start, the range is set to what the argument says."""
    kinds = [type(entry).__name__ for entry in described]
    (setting,) = of_kind(described, 'SetEnvironmentVariable')
    name, value = setting.args
    assert name == 'ROS_AUTOMATIC_DISCOVERY_RANGE' and value.args == ('discovery_range',)
    assert kinds.index('SetEnvironmentVariable') < kinds.index('Node')


def test_launch_starts_executables_wired_to_each_other(described):
    nodes = of_kind(described, 'Node')
    assert [n.kwargs['name'] for n in nodes] == list(NODES)
    assert set(yaml.safe_load(FILE.read_text())) == {f'/**/{name}' for name in NODES}
    scripts = metadata()['scripts']
    for node in nodes:
        name = node.kwargs['executable']
        assert node.kwargs['package'] == 'ou_monitor'
        assert scripts[name] == f'ou_monitor.nodes.__main__:{name}'
        assert node.kwargs['namespace'].args == ('namespace',)
        assert node.kwargs['ros_arguments'][:3] == [
            '--enclave', f'/ou_monitor/{name}', '--log-level']
        assert node.kwargs['ros_arguments'][3].args == ('log_level',)
        assert node.kwargs['respawn'].args == ('respawn',)
        file, extra = node.kwargs['parameters']
        assert file.args == ('params_file',)
        assert extra['use_sim_time'].args == ('use_sim_time',)
    assert nodes[1].kwargs['remappings'][:2] == [
        ('sigma', 'ou_estimator/sigma'), ('state', 'ou_estimator/state')]
    mapped = [(name, value.args[0]) for node in nodes for name, value in node.kwargs['remappings']
              if not isinstance(value, str)]
    assert mapped == [('voltage', 'voltage'), ('throttle', 'throttle'), ('input', 'input')]
    assert nodes[1].kwargs['condition'].args[0].args == ('filter',)


def test_a_parameter_file_that_is_not_there_is_an_error(described, tmp_path):
    """Before any node starts; ROS 2 would take the defaults."""
    kinds = [type(entry).__name__ for entry in described]
    assert kinds.index('OpaqueFunction') < kinds.index('Node')
    refuse = described[kinds.index('OpaqueFunction')].kwargs['function']
    given = {'params_file': str(tmp_path / 'none.yaml')}
    configuration = refuse.__globals__['LaunchConfiguration']
    configuration.perform = lambda self, context: context[self.args[0]]
    with pytest.raises(RuntimeError, match='there is no file .*none.yaml'):
        refuse(given)
    refuse({'params_file': str(FILE)})


@pytest.mark.parametrize('described', [TWO], indirect=True)
def test_two_batteries_are_two_scopes_of_one_launch(described):
    known = {name for name, _, _ in _arguments_of(LAUNCH)}
    declared = {a.args[0] for a in of_kind(described, 'DeclareLaunchArgument')}
    groups = of_kind(described, 'GroupAction')
    assert len(groups) == 2
    for number, group in zip('12', groups, strict=True):
        assert group.kwargs == {'scoped': True}
        (include,) = group.args[0]
        assert include.args[0].args == (str(LAUNCH),)
        given = dict(include.kwargs['launch_arguments'])
        assert set(given) <= known and given.pop('filter') == 'false'
        used = {value.args[0] for value in given.values()}
        assert used <= declared and f'voltage_{number}' in used


@pytest.mark.parametrize('described', [SIMULATED], indirect=True)
def test_the_simulated_launch_includes_the_other(described):
    (include,), (node,) = of_kind(described, 'IncludeLaunchDescription'), of_kind(
        described, 'Node')
    kinds = [type(entry).__name__ for entry in described]
    assert kinds.index('IncludeLaunchDescription') < kinds.index('Node')
    assert include.args[0].args == (str(LAUNCH),)
    known = {name for name, _, _ in _arguments_of(LAUNCH)}
    assert set(dict(include.kwargs['launch_arguments'])) <= known
    arguments = {a.args[0]: a.kwargs['default_value']
                 for a in of_kind(described, 'DeclareLaunchArgument')}
    for name in ('model_file', 'params_file'):
        assert Path(arguments[name]).is_file()
    (values,) = node.kwargs['parameters']
    assert set(values) - {'use_sim_time'} <= {
        p.name for p in (*SupplySimulatorNode.RUN_TIME, *SupplySimulatorNode.FIXED)}
    own = yaml.safe_load((ROOT / 'config' / 'simulated.yaml').read_text())
    assert set(flat(own['/**/ou_estimator']['ros__parameters'])) <= {
        p.name for p in (*EstimatorNode.RUN_TIME, *EstimatorNode.FIXED)}


def _arguments_of(path):
    """Return the table of arguments of a launch file."""
    tree = ast.parse(path.read_text())
    (value,) = [node.value for node in tree.body if isinstance(node, ast.Assign)
                and node.targets[0].id == 'ARGUMENTS']
    return [(entry.elts[0].value, None, None) for entry in value.elts]


def test_the_file_is_taken_in_any_namespace(world):
    from live import wait_until
    from rcl_interfaces.srv import GetParameters
    changed = world.folder / 'changed.yaml'
    changed.write_text(FILE.read_text().replace('window: auto', 'window: 7.5').replace(
        'fmax: 150.0', 'fmax: 111.0'))
    probe = world.probe()
    processes = [
        world.start(name, '--ros-args', '--params-file', str(changed), '-r', f'__ns:={space}')
        for name in ('estimator', 'adaptive_filter') for space in ('/', '/n/m')]
    for node, key, value in (('ou_estimator', 'window', 7.5),
                             ('ou_adaptive_filter', 'fmax', 111.0)):
        for space in ('', '/n/m'):
            answer = probe.call(GetParameters, f'{space}/{node}/get_parameters',
                                GetParameters.Request(names=[key]))
            assert answer.values[0].double_value == value
    assert all('[WARN]' not in process.err for process in processes)
    wait_until(lambda: [process.stop() for process in processes] == [0] * 4)


needs_ros2 = pytest.mark.skipif(
    shutil.which('ros2') is None or subprocess.run(
        ['ros2', 'pkg', 'prefix', 'ou_monitor'], capture_output=True, check=False).returncode != 0,
    reason='needs a sourced ROS 2 with `ros2 launch`, and the workspace of this package')

LAUNCHED = {'ou_monitor_launch.py': ['/ou_estimator', '/ou_adaptive_filter'],
         'ou_monitor_two_batteries_launch.py': [
             '/battery_1/ou_estimator', '/battery_2/ou_estimator'],
         'ou_monitor_simulated_launch.py': [
             '/supply_simulator', '/ou_estimator', '/ou_adaptive_filter']}


@needs_ros2
@pytest.mark.parametrize('file', LAUNCHED)
def test_nodes_come_up_and_end(world, file):
    """Those that are described are seen, and SIGINT ends all of them with status 0."""
    probe = world.probe()
    launched = subprocess.Popen(
        # -n: at a terminal `ros2 launch` leaves the signal of its nodes to the terminal.
        ['ros2', 'launch', '-n', 'ou_monitor', file], start_new_session=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(world.domain)})
    try:
        wait_until(lambda: set(LAUNCHED[file]) <= set(probe.node.get_fully_qualified_node_names()),
                   what=f'{LAUNCHED[file]}')
        launched.send_signal(signal.SIGINT)
        assert launched.wait(60) == 0
    finally:
        if launched.poll() is None:
            os.killpg(launched.pid, signal.SIGKILL)
            launched.wait()


@needs_ros2
def test_a_missing_parameter_file_starts_no_node(tmp_path):
    done = subprocess.run(
        ['ros2', 'launch', 'ou_monitor', 'ou_monitor_launch.py',
         f'params_file:={tmp_path}/none.yaml'], capture_output=True, text=True, timeout=120,
        check=False)
    assert done.returncode != 0 and 'there is no file' in done.stdout + done.stderr


FOXGLOVE = ROOT / 'layouts' / 'ou_monitor_foxglove.json'
PLOTJUGGLER = ROOT / 'layouts' / 'ou_monitor_plotjuggler.xml'
# Foxglove: /topic.field; PlotJuggler: /topic/field.
SUPPLY = {'alpha', 'sigma', 'var_inf', 'brownout_risk', 'brownout', 'throttle_budget'}
FILTER = {'cutoff', 'lag'}
FLAG = '/ou_estimator/state.status[0].values[:]{key=="brownout"}.value'


@pytest.fixture(scope='module')
def topics() -> dict[str, set[str]]:
    """Return the topics that the nodes publish, and those that carry their inputs, with types."""
    found: dict[str, set[str]] = {}
    rclpy.init(domain_id=61)
    try:
        from ou_monitor.nodes.adaptive_filter_node import AdaptiveFilterNode
        from ou_monitor.nodes.estimator_node import EstimatorNode
        for kind, name in ((EstimatorNode, 'ou_estimator'),
                           (AdaptiveFilterNode, 'ou_adaptive_filter')):
            node = kind(name)
            for topic, types in node.get_publisher_names_and_types_by_node(name, '/'):
                found.setdefault(topic, set()).update(types)
            node.destroy_node()
    finally:
        rclpy.shutdown()
    for config in list_msg_configs().values():
        for spec in (config.voltage, config.throttle):
            if spec is not None and spec.topic in ('voltage', 'throttle'):
                found.setdefault('/' + spec.topic, set()).add(spec.type)
    return found


def foxglove() -> dict:
    return json.loads(FOXGLOVE.read_text(encoding='utf-8'))


def foxglove_paths() -> dict[str, str]:
    """Return topic -> field of every path; an empty field for whole messages."""
    found = []
    for panel in foxglove()['configById'].values():
        found += [path['value'] for path in panel.get('paths', [])]
        found += [panel[key] for key in ('path', 'topicPath', 'topicToRender') if key in panel]
    # The indicator picks the flag's value in the state by its key.
    found = ['/ou_estimator/brownout.data' if path == FLAG else path for path in found]
    return split(re.fullmatch(r'(/[\w/]+)(?:\.([\w.]+))?', path).groups('') for path in found)


def plotjuggler_paths() -> dict[str, str]:
    root = ElementTree.parse(PLOTJUGGLER).getroot()
    return split(curve.get('name').rsplit('/', 1) for curve in root.iter('curve'))


def split(pairs) -> list[tuple[str, str]]:
    """Return pairs of topic and field, each once."""
    return sorted({(topic, field) for topic, field in pairs})


def has_field(kind: str, field: str) -> bool:
    """Return whether a message type has a field that can be drawn."""
    package, _, name = kind.split('/')
    message = getattr(import_module(f'{package}.msg'), name)()
    for word in parse_field_path(field):
        if not hasattr(message, str(word)):
            return False
        message = getattr(message, str(word))
    return isinstance(message, (bool, int, float))


@pytest.mark.parametrize('paths', [foxglove_paths, plotjuggler_paths])
def test_every_path_is_there(paths, topics):
    """Each topic is published by a node or carries an input, and a type of it has the field."""
    for topic, field in paths():
        assert topic in topics, topic
        if field:
            assert any(has_field(kind, field) for kind in topics[topic]), (topic, field)


@pytest.mark.parametrize('paths', [foxglove_paths, plotjuggler_paths])
def test_nothing_is_missing(paths):
    drawn = {topic for topic, _ in paths()}
    assert {'/voltage', '/throttle', *(f'/ou_estimator/{name}' for name in SUPPLY),
            *(f'/ou_adaptive_filter/{name}' for name in FILTER)} <= drawn


POLICY = ROOT / 'security' / 'ou_monitor_policy.xml'
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
    return ElementTree.parse(POLICY).getroot()


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
