"""Descriptions of messages, and the fields that they name."""

import shutil

from ou_monitor.errors import InputError
from ou_monitor.stream.config import (
    FieldSpec, list_msg_configs, load_msg_config, ManyExtractor, msg_config_dir, parse_field_path)
import pytest
import yaml


SHIPPED = {'std_float32', 'std_float64', 'adc_block', 'battery_state', 'px4', 'mavros',
           'ardupilot_dds'}

GOOD = {
    'description': 'a rail', 'package': 'my_msgs', 'install': 'my_msgs', 'generic': False,
    'voltage': {'topic': '/rail', 'type': 'my_msgs/msg/Rail', 'field': 'cells[0].mv',
                'unit_factor': 1.0e-3, 'sign': -1, 'offset': 0.5, 'nan': 'unknown',
                'stamp_field': 'stamp_us', 'stamp_factor': 1.0e-6},
    'throttle': None,
}


def written(tmp_path, change=None, part=None, name='rail.yaml'):
    """Write GOOD with some keys changed; return the file."""
    content = {**GOOD, 'voltage': dict(GOOD['voltage'])}
    (content if part is None else content[part]).update(change or {})
    path = tmp_path / name
    path.write_text(yaml.safe_dump(content), encoding='utf-8')
    return path


def test_the_shipped_msg_configs_load():
    """Every file of the package is valid, and all that were promised are there."""
    configs = list_msg_configs()
    assert set(configs) >= SHIPPED
    for name, config in configs.items():
        assert config.name == name
        assert config.description and config.install
        # That of our own node is asked for by name: its rate is not in the message.
        assert config.generic == (not config.voltage.topic.startswith('/') and name != 'adc')


def test_a_msg_config_is_read_as_written(tmp_path):
    config = load_msg_config(written(tmp_path))
    spec = config.voltage
    assert (config.name, config.package, config.generic) == ('rail', 'my_msgs', False)
    assert (spec.topic, spec.field) == ('/rail', 'cells[0].mv')
    assert (spec.unit_factor, spec.sign, spec.offset) == (1e-3, -1, 0.5)
    assert (spec.nan, spec.stamp_field, spec.stamp_factor) == ('unknown', 'stamp_us', 1e-6)
    assert spec.sample_rate is None
    assert config.throttle is None


def test_px4_throttle_is_mapped_to_0_1():
    spec = load_msg_config('px4').throttle
    ends = [spec.sign * spec.unit_factor * raw + spec.offset for raw in (-1.0, 1.0)]
    assert ends == [0.0, 1.0]


@pytest.mark.parametrize('part, change, expected', [
    ('voltage', {'unit_facto': 1.0}, ["unknown key 'unit_facto'", "'unit_factor'", 'voltage']),
    (None, {'descripton': 'x'}, ["unknown key 'descripton'", "'description'"]),
    (None, {'generic': 'yes'}, ["'generic'", 'true or false', "'yes'"]),
    (None, {'voltage': None}, ["'voltage'", 'None']),
    ('voltage', {'unit_factor': '1e-3'}, ["'unit_factor'", 'a number', '1.0e-3']),
    ('voltage', {'unit_factor': True}, ["'unit_factor'", 'a number', 'True']),
    ('voltage', {'unit_factor': -1.0}, ["'unit_factor'", 'sign']),
    ('voltage', {'offset': float('nan')}, ["'offset'", 'finite']),
    ('voltage', {'sign': 2}, ['sign', '1 or -1', '2']),
    ('voltage', {'nan': 'dorp'}, ["'dorp'", "'drop'"]),
    ('voltage', {'sample_rate': 0}, ['sample_rate', 'above 0']),
    ('voltage', {'sample_rate': -5.0}, ['sample_rate', 'above 0']),
    (None, {'throttle': {**GOOD['voltage'], 'sample_rate': 5.0}}, ['blocks of the voltage']),
    ('voltage', {'type': 'my_msgs/Rail'}, ["'my_msgs/Rail'", 'package/msg/Type']),
    ('voltage', {'topic': 'a b'}, ["'a b'", 'topic']),
    ('voltage', {'field': 'cells[x]'}, ["'cells[x]'"]),
    ('voltage', {'field': f'cells[{"9" * 5000}]'}, ['field path', '...']),
    ('voltage', {'x' * 5000: 1}, ['unknown key: valid: ']),
    ('voltage', {'stamp_field': 3}, ["'stamp_field'", 'text or null', '3']),
])
def test_a_mistake_is_named(tmp_path, part, change, expected):
    """One line: file, key, and what to write instead."""
    path = written(tmp_path, change, part)
    with pytest.raises(InputError) as caught:
        load_msg_config(path)
    text = str(caught.value)
    assert '\n' not in text
    for words in [str(path), *expected]:
        assert words in text


@pytest.mark.parametrize('key', ['topic', 'type', 'field'])
def test_a_missing_key_is_named(tmp_path, key):
    content = {**GOOD, 'voltage': {k: v for k, v in GOOD['voltage'].items() if k != key}}
    path = tmp_path / 'rail.yaml'
    path.write_text(yaml.safe_dump(content), encoding='utf-8')
    with pytest.raises(InputError, match=f"voltage: key '{key}' is missing"):
        load_msg_config(path)


@pytest.mark.parametrize('text, expected', [
    ('a: [', 'not YAML'), ('', 'expected keys'), ('- 1\n', 'expected keys')])
def test_file_without_a_mapping_is_refused(tmp_path, text, expected):
    """Broken YAML and empty files are one line."""
    path = tmp_path / 'rail.yaml'
    path.write_text(text, encoding='utf-8')
    with pytest.raises(InputError, match=expected) as caught:
        load_msg_config(path)
    assert '\n' not in str(caught.value)


def test_unknown_name_and_missing_file(tmp_path):
    with pytest.raises(InputError, match="no msg config 'batery_state'.*'battery_state'"):
        load_msg_config('batery_state')
    with pytest.raises(InputError, match='nowhere.yaml'):
        load_msg_config(tmp_path / 'nowhere.yaml')


@pytest.mark.parametrize('layout', [
    'lib/python3.12/site-packages', 'local/lib/python3.12/dist-packages',
    'install/ou_monitor/lib/python3.12/site-packages'])
def test_msg_configs_are_found_when_installed(tmp_path, monkeypatch, layout):
    """It is found from the package's place under a prefix, as pip and colcon lay it out."""
    package = tmp_path / layout / 'ou_monitor' / 'messages'
    package.mkdir(parents=True)
    prefix = tmp_path / layout.split('lib/')[0]
    share = prefix / 'share' / 'ou_monitor' / 'msg_config'
    shutil.copytree(msg_config_dir(), share)
    monkeypatch.setattr('ou_monitor.stream.config.__file__', str(package / 'config.py'))
    assert msg_config_dir() == share


def test_a_missing_folder_of_msg_configs_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr('ou_monitor.stream.config.__file__', str(tmp_path / 'a/b/c/config.py'))
    with pytest.raises(InputError, match='no msg_config folder'):
        msg_config_dir()


@pytest.mark.parametrize('path, steps', [
    ('data', ('data',)), ('header.stamp', ('header', 'stamp')),
    ('channels[0].value', ('channels', 0, 'value')), ('a[1][20]', ('a', 1, 20))])
def test_a_field_path_has_names_and_indices(path, steps):
    assert parse_field_path(path) == steps


@pytest.mark.parametrize('path', ['', '.', 'a.', 'a[', 'a[-1]', 'a[0', '[0]', 'a b', '1a', 'a..b'])
def test_a_malformed_path_is_refused_at_once(path):
    with pytest.raises(InputError, match='field path'):
        parse_field_path(path)


class Message:
    """Looks like an rclpy message."""

    def __init__(self, **fields):
        self.__dict__ |= fields

    def get_fields_and_field_types(self):
        """Return what rclpy would, by instance here."""
        return dict.fromkeys(self.__dict__, 'float')


ESCS = Message(esc=[Message(rpm=1000), Message(rpm=2000.5)], all=[1.0, 2.0, 3.0], one=4, name='x')


@pytest.mark.parametrize('field, values', [
    ('esc[].rpm', [100.0, 200.05]), ('all', [0.1, 0.2, 0.3]), ('all[]', [0.1, 0.2, 0.3]),
    ('esc[1].rpm', [200.05]), ('one', [0.4]), ('esc[7].rpm', [])])
def test_several_numbers_are_extracted(field, values):
    """A field of each element, an array, an element, a number; empty if there is none."""
    extractor = ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field, unit_factor=0.1))
    assert extractor.extract(ESCS).tolist() == pytest.approx(values)


@pytest.mark.parametrize('field, words', [
    ('esc[].rp', "did you mean 'rpm'"), ('name', 'holds no numbers'), ('esc', 'holds no numbers'),
    ('esc[]]', 'not of the form'), ('one[]', 'holds no numbers'), ('one[0]', 'not an array')])
def test_lists_without_numbers_are_refused(field, words):
    with pytest.raises(InputError, match=words):
        ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field)).extract(ESCS)
