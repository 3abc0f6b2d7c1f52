"""For colcon, which runs this file; pyproject.toml has all that it does not say."""

from pathlib import Path

from setuptools import setup

# `colcon build --symlink-install` runs it in a folder of links, where these are missing.
for name in ('pyproject.toml', 'README.md'):
    if not Path(name).exists():
        Path(name).symlink_to(Path(__file__).resolve().with_name(name))
# From pyproject.toml the Python would be an object, and colcon reads literals only; and no form of
# the licence suits both setuptools 68 (of Ubuntu 24.04) and those from 77 on.
setup(python_requires='>=3.11', license='Apache-2.0')
