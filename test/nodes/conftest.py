"""Fixtures: a ROS domain with real processes in it."""

from live import World
import pytest


def pytest_collection_modifyitems(items):
    """
    Let a test run once more that waited in vain for a message or an answer.

    The middleware loses some on a machine that has too much to do: 1 of 7413 tests in one of
    three runs of the suite.  A wrong value or a traceback is not forgiven.
    """
    for item in items:
        if ({'world', 'shared_world'} & set(getattr(item, 'fixturenames', ()))
                and item.get_closest_marker('flaky') is None):
            item.add_marker(pytest.mark.flaky(reruns=1, only_rerun='not within '))


@pytest.fixture
def world(tmp_path):
    """Give a ROS domain of its own."""
    made = World(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope='module')
def shared_world(tmp_path_factory):
    """Give a ROS domain for all tests of a module."""
    made = World(tmp_path_factory.mktemp('world'))
    yield made
    made.close()
