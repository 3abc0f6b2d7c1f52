"""Setup for colcon, which runs this file; pyproject.toml has everything else."""

from pathlib import Path

from setuptools import setup

# `colcon build --symlink-install` runs this in a folder of links without these two files.
for name in ('pyproject.toml', 'README.md'):
    if not Path(name).exists():
        Path(name).symlink_to(Path(__file__).resolve().with_name(name))
# Here rather than in pyproject.toml: colcon reads only literals, and no form of the licence suits
# both setuptools 68 (of Ubuntu 24.04) and setuptools from 77 on.
setup(python_requires='>=3.11', license='Apache-2.0')
