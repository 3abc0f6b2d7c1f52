"""Which tests may run beside each other: files may, but all that starts ROS goes one by one."""

import pytest

_ROS = ('nodes/', 'test_package.py', 'test_scripts.py', 'test_readme.py')


def pytest_collection_modifyitems(items):
    """Keep a file together on one worker of pytest-xdist, and all ROS on the same one."""
    for item in items:
        path = str(item.path.relative_to(item.config.rootpath / 'test'))
        group = 'ros' if path.startswith(_ROS) else path
        item.add_marker(pytest.mark.xdist_group(group))
