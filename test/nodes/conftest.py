"""Fixtures: a ROS domain with real processes in it."""

from live import World
import pytest


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
