"""The layouts of Foxglove and PlotJuggler use only topics of the nodes."""

from importlib import import_module
import json
import re
import xml.etree.ElementTree as ElementTree

from ou_monitor.stream.config import list_msg_configs, parse_field_path
from project import ROOT
import pytest
import rclpy

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
