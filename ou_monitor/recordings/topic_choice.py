"""
Which msg_config, and which topics, a bag's voltage and throttle come from.

A config fits by name when the bag has its topic (or one that ends with it, as
in a namespace) with its type; a generic one fits by type alone when there is
only one topic of that type.  One choice is taken, several are put to the user.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from ou_monitor.errors import InputError, nearest
from ou_monitor.stream.config import FieldSpec, list_msg_configs, load_msg_config, MsgConfig
from ou_monitor.text import some


@dataclass(frozen=True)
class Choice:
    """What is read from a bag."""

    # The source.
    config: MsgConfig
    # With the topics of this bag; throttle and current are None where there is none.
    voltage: FieldSpec
    throttle: FieldSpec | None
    current: FieldSpec | None
    # One sentence for each thing that was not as expected.
    notes: tuple[str, ...]


def choose(
    path: Path, topics: Mapping[str, str], *, msg_config: str | Path | None = None,
    voltage_topic: str | None = None, throttle_topic: str | None = None,
) -> Choice:
    """Choose the config and the topics."""
    for topic in (voltage_topic, throttle_topic):
        if topic is not None and _absolute(topic) not in topics:
            raise InputError(f"{path}: no topic '{topic}': {nearest(_absolute(topic), topics)}")
    if msg_config is not None:
        config = load_msg_config(msg_config)
    else:
        config = _detect(path, topics, voltage_topic)
    if voltage_topic is not None:
        topic = _absolute(voltage_topic)
        if topics[topic] != config.voltage.type:
            raise InputError(
                f"{path}: topic '{topic}' is {topics[topic]}, but msg config '{config.name}' "
                f'expects {config.voltage.type}: choose another with --msg-config')
    else:
        found = _named(config.voltage, topics) or _only_of_type(config, topics)
        if not found:
            raise InputError(_not_there(path, config, topics))
        if len(found) > 1:
            raise InputError(f'{path}: several topics fit: {some(found)}; choose with '
                             '--voltage-topic')
        topic = found[0]
    throttle, notes = _throttle(path, config, topics, topic, throttle_topic)
    others = [name for name in _alike(config.voltage, topics) if name != topic]
    if voltage_topic is None and others:
        notes = (*notes, f'{topic} was taken for the voltage; {some(others)} would fit too: '
                         'choose with --voltage-topic.')
    return Choice(config, replace(config.voltage, topic=topic), throttle,
                  _current(config, topics, topic), notes)


def listed(topics: Mapping[str, str]) -> str:
    """Return topics with their types in one line."""
    return some(f'{name} ({kind})' for name, kind in sorted(topics.items()))


def _absolute(topic: str) -> str:
    return '/' + topic.lstrip('/')


def _named(spec: FieldSpec, topics: Mapping[str, str]) -> list[str]:
    """Return the topics that a spec means by name, of its type."""
    exact = _absolute(spec.topic)
    if topics.get(exact) == spec.type:
        return [exact]
    return _alike(spec, topics)


def _alike(spec: FieldSpec, topics: Mapping[str, str]) -> list[str]:
    """Return the topics of its type that end with the name that a spec means."""
    return sorted(name for name, kind in topics.items()
                  if kind == spec.type and name.endswith(_absolute(spec.topic)))


def _only_of_type(config: MsgConfig, topics: Mapping[str, str]) -> list[str]:
    """Return the topics of the voltage's type, those that are the throttle by name left out."""
    taken = set() if config.throttle is None else set(_named(config.throttle, topics))
    return sorted(name for name, kind in topics.items()
                  if kind == config.voltage.type and name not in taken)


def _detect(path: Path, topics: Mapping[str, str], voltage_topic: str | None) -> MsgConfig:
    configs = list(list_msg_configs().values())
    considered = topics if voltage_topic is None else {
        _absolute(voltage_topic): topics[_absolute(voltage_topic)]}
    fitting = [config for config in configs if _named(config.voltage, considered)]
    if not fitting:
        # With a topic named by the user its type decides; else the throttle's
        # topic must be known, to leave it out.
        known = considered if voltage_topic is not None else topics
        fitting = [config for config in configs
                   if config.generic and _only_of_type(config, known)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(
            f"{path}: several msg configs fit ({', '.join(c.name for c in fitting)}); choose "
            f'with --msg-config; topics: {listed(topics)}')
    raise InputError(
        f'{path}: no topic looks like a supply voltage; topics: {listed(topics)}; choose with '
        f"--msg-config one of {', '.join(c.name for c in configs)}, or a YAML file of your own")


def _not_there(path: Path, config: MsgConfig, topics: Mapping[str, str]) -> str:
    wanted = _absolute(config.voltage.topic)
    kind = topics.get(wanted)
    if kind is not None:
        return (f"{path}: topic '{wanted}' is {kind}, but msg config '{config.name}' expects "
                f'{config.voltage.type}: choose another with --msg-config')
    return (f"{path}: msg config '{config.name}' needs topic '{wanted}' "
            f'({config.voltage.type}), which is not in the bag; topics: {listed(topics)}')


def _current(config: MsgConfig, topics: Mapping[str, str], voltage: str) -> FieldSpec | None:
    """Return where the current is: a topic of that name beside the voltage, or as configured."""
    beside = voltage.rsplit('/', 1)[0] + '/current'
    if topics.get(beside) in ('std_msgs/msg/Float32', 'std_msgs/msg/Float64'):
        return FieldSpec(beside, topics[beside], 'data', nan='unknown')
    spec = config.current
    if spec is None or spec.topic != config.voltage.topic:
        return None
    return replace(spec, topic=voltage)


def _throttle(
    path: Path, config: MsgConfig, topics: Mapping[str, str], voltage: str,
    throttle_topic: str | None,
) -> tuple[FieldSpec | None, tuple[str, ...]]:
    """Return where the throttle is, or why there is none."""
    spec = config.throttle
    if throttle_topic is not None:
        topic = _absolute(throttle_topic)
        # A source without a throttle of its own, or one of another type, is
        # read as any shipped config reads that type.
        specs = [spec] + [c.throttle for c in list_msg_configs().values()]
        for one in specs:
            if one is not None and one.type == topics[topic]:
                return replace(one, topic=topic), ()
        if topics[topic] == 'std_msgs/msg/Float64':
            return FieldSpec(topic, topics[topic], 'data'), ()
        raise InputError(f"{path}: throttle topic '{topic}' is {topics[topic]}, which no msg "
                         'config reads: name one in a YAML file of your own')
    if spec is None:
        return None, (f"Msg config '{config.name}' has no throttle: it is unknown.",)
    found = _named(spec, topics)
    if not found and not config.generic:
        found = [name for name, kind in topics.items() if kind == spec.type and name != voltage]
    # In a bag of several vehicles the one beside the voltage is meant.
    beside = [name for name in found if name.rsplit('/', 1)[0] == voltage.rsplit('/', 1)[0]]
    found = beside or found
    if len(found) == 1:
        return replace(spec, topic=found[0]), ()
    wanted = _absolute(spec.topic)
    if not found and topics.get(wanted) == 'std_msgs/msg/Float64' and config.generic:
        return replace(spec, topic=wanted, type=topics[wanted]), ()
    if wanted in topics and not found:
        why = f"topic '{wanted}' is {topics[wanted]}, not {spec.type}"
    else:
        why = f'several topics fit ({some(found)})' if found else f"no topic '{wanted}'"
    return None, (f'The throttle is unknown: {why}; name one with --throttle-topic.',)
