"""Sources of voltage and throttle, and what the console says while none is there."""

import math
from types import SimpleNamespace

from ou_monitor.errors import InputError
from ou_monitor.nodes.inputs import AGAIN, Console, MUTE
from ou_monitor.nodes.sources import find_source, message_class, SOURCE_PARAMETERS
import pytest


def values(**changed):
    """Return the parameters, some changed (`__` stands for the dot)."""
    found = {p.name: p.default for p in SOURCE_PARAMETERS}
    for name, value in changed.items():
        assert name.replace('__', '.') in found
        found[name.replace('__', '.')] = value
    return found


def test_auto_chooses_by_type():
    source = find_source('voltage', values())
    assert source.spec is None and source.topic == 'voltage'
    kinds = {'std_msgs/msg/Float32': 'data', 'std_msgs/msg/Float64': 'data',
             'sensor_msgs/msg/BatteryState': 'voltage',
             'std_msgs/msg/Float32MultiArray': 'data'}
    for kind, field in kinds.items():
        chosen = source.choose(['std_msgs/msg/String', kind])
        assert (chosen.spec.type, chosen.spec.field) == (kind, field)
        assert chosen.open() == (message_class(kind), chosen.spec)
    assert source.choose(['std_msgs/msg/String']) is None


@pytest.mark.parametrize('kind', ['std_msgs/msg/Float32', 'std_msgs/msg/Float64'])
def test_auto_takes_any_scalar_throttle(kind):
    assert find_source('throttle', values()).choose([kind]).spec.field == 'data'


def test_a_named_config_says_all():
    source = find_source('voltage', values(msg_config='battery_state'))
    assert (source.spec.type, source.spec.field, source.config) == (
        'sensor_msgs/msg/BatteryState', 'voltage', 'battery_state')


def test_overrides_change_single_entries():
    """The rest stays as the msg_config says."""
    source = find_source('voltage', values(
        msg_config='adc_block', voltage__topic='/adc', adc__sample_rate=250.0))
    assert (source.topic, source.spec.topic, source.spec.sample_rate, source.spec.field) == (
        '/adc', '/adc', 250.0, 'data')


def test_a_rate_does_not_make_a_block_of_a_scalar():
    """In auto mode the rate belongs to blocks alone."""
    source = find_source('voltage', values(adc__sample_rate=250.0))
    assert source.choose(['std_msgs/msg/Float32']).spec.sample_rate is None
    assert source.choose(['std_msgs/msg/Float32MultiArray']).spec.sample_rate == 250.0


def test_any_installed_type_by_name_and_path():
    source = find_source('voltage', values(
        voltage__type='sensor_msgs/msg/Temperature', voltage__field='temperature'))
    assert source.spec.stamp_field == 'header.stamp' and source.open()
    source = find_source('voltage', values(
        voltage__type='geometry_msgs/msg/Vector3', voltage__field='z', voltage__topic='/v'))
    assert source.spec.stamp_field is None and source.topic == '/v'


def test_a_config_without_throttle():
    assert find_source('throttle', values(msg_config='ardupilot_dds')) is None
    named = values(msg_config='ardupilot_dds', throttle__topic='/t',
                   throttle__type='std_msgs/msg/Float32', throttle__field='data')
    assert find_source('throttle', named).topic == '/t'


@pytest.mark.parametrize('changed, words', [
    ({'msg_config': 'std_float3'}, "did you mean 'std_float32'?"),
    ({'msg_config': 'nowhere/x.yaml'}, 'nowhere/x.yaml'),
    ({'voltage__type': 'geometry_msgs/msg/Vector3'}, 'give voltage.field'),
    ({'voltage__type': 'px4_msgs/msg/X', 'voltage__field': 'v'}, 'ros-jazzy-px4-msgs'),
])
def test_a_refusal_says_what_to_do(changed, words):
    with pytest.raises(InputError) as caught:
        find_source('voltage', values(**changed))
    assert words in str(caught.value) and '\n' not in str(caught.value)


@pytest.mark.parametrize('name, words', [
    ('Float32', "write 'package/msg/Type'"),
    ('std_msgs/Float32', "write 'package/msg/Type'"),
    ('os/msg/path; x', "write 'package/msg/Type'"),
    ('std_msgs/msg/Float23', "did you mean 'Float32'?"),
    ('px4_msgs/msg/BatteryStatus', "package 'px4_msgs', which is not installed"),
])
def test_unavailable_types_are_refused(name, words):
    with pytest.raises(InputError, match='.') as caught:
        message_class(name)
    assert words in str(caught.value)


def test_a_wrong_field_is_told_before_any_message():
    """Opening tries the path on an empty message."""
    source = find_source('voltage', values(msg_config='std_float32', voltage__field='dat'))
    with pytest.raises(InputError, match="did you mean 'data'?"):
        source.open()


def test_a_bag_does_not_choose_what_is_imported(tmp_path, monkeypatch):
    (tmp_path / 'evil_msgs').mkdir()
    (tmp_path / 'evil_msgs' / '__init__.py').write_text('')
    (tmp_path / 'evil_msgs' / 'msg.py').write_text(
        f'open({str(tmp_path / "done")!r}, "w").close()\nclass Evil:\n    pass\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ('evil_msgs/msg/Evil', 'antigravity/msg/Evil', '__main__/msg/Evil'):
        with pytest.raises(InputError, match='not installed'):
            message_class(name)
    assert not (tmp_path / 'done').exists()
    # A prefix that is sourced names its own.
    index = tmp_path / 'share' / 'ament_index' / 'resource_index' / 'packages'
    index.mkdir(parents=True)
    (index / 'evil_msgs').touch()
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    with pytest.raises(InputError, match="no message 'Evil'"):
        message_class('evil_msgs/msg/Evil')
    with pytest.raises(InputError, match='no message'):
        message_class('std_msgs/msg/__loader__')


def test_motor_speeds_are_scalars_arrays_or_fields():
    from ou_monitor.nodes.sources import MOTOR_PARAMETERS
    from std_msgs.msg import Float64MultiArray
    found = {p.name: p.default for p in MOTOR_PARAMETERS}
    assert find_source('rpm', {**found, 'msg_config': 'px4'}).spec.field == 'esc[].esc_rpm'
    source = find_source('rpm', found).choose(['std_msgs/msg/Float64MultiArray'])
    _, extractor = source.open_many()
    assert extractor.extract(Float64MultiArray(data=[1.0, 2.0])).tolist() == [1.0, 2.0]
    assert find_source('rpm', {**found, 'msg_config': 'ardupilot_dds'}) is None


def test_missing_messages_are_explained():
    """No publisher: at once and each minute; one that is silent: after 10 s, then each minute."""
    said, publishers, clock = [], 0, 0.0
    logged = {}

    def info(text, throttle_duration_sec):
        # As rclpy: each place in the source has its own throttle.
        if clock - logged.get(text[:8], -math.inf) >= throttle_duration_sec:
            logged[text[:8]] = clock
            said.append((clock, text))
    node = SimpleNamespace(
        steady_now=lambda: clock, resolve_topic_name=lambda name: f'/{name}',
        count_publishers=lambda name: publishers,
        get_topic_names_and_types=lambda: [('/uav1/rail', ['x'])],
        get_logger=lambda: SimpleNamespace(info=info))
    console = Console(node)
    while clock < 100.0:
        console.waiting('rail')
        clock += 1.0
    assert [time for time, _ in said] == [0.0, AGAIN]
    assert said[0][1] == 'Waiting for a publisher on /rail (there is /uav1/rail).'
    publishers = 1
    del said[:]
    while clock < 200.0:
        console.waiting('rail')
        clock += 1.0
    assert [time for time, _ in said] == [99.0 + MUTE, 99.0 + MUTE + AGAIN]
    assert said[0][1].startswith('/rail has a publisher, but no message has arrived')
    # One that goes and comes again has its time again.
    publishers = 0
    console.waiting('rail')
    publishers = 1
    del said[:]
    console.waiting('rail')
    assert not said
