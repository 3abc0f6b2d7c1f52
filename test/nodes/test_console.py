"""Messages on the console while no data arrive, and their timing."""

from types import SimpleNamespace

from ou_monitor.nodes.inputs import AGAIN, Console, MUTE


def test_missing_messages_are_explained():
    """No publisher: at once and each minute; one that is silent: after 10 s, then each minute."""
    said, publishers, clock = [], 0, 0.0
    node = SimpleNamespace(
        steady_now=lambda: clock, resolve_topic_name=lambda name: f'/{name}',
        count_publishers=lambda name: publishers,
        get_topic_names_and_types=lambda: [('/uav1/rail', ['x'])],
        get_logger=lambda: SimpleNamespace(info=lambda text: said.append((clock, text))))
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
    assert [time for time, _ in said] == [100.0 + MUTE, 100.0 + MUTE + AGAIN]
    assert said[0][1].startswith('/rail has a publisher, but no message has arrived')
    # One that goes and comes again has its time again.
    publishers = 0
    console.waiting('rail')
    publishers = 1
    del said[:]
    console.waiting('rail')
    assert not said
