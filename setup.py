"""Package for ament_python (colcon) and for pip; the offline half needs no ROS."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'ou_monitor'
SHARE = 'share/' + NAME
# What reads the logs of autopilots.  The wheel of orangebox 0.5.0 cannot be installed: pip
# refuses the entry point in it.
LOGS = {'ulog': ['pyulog>=1.1,<2'], 'dataflash': ['pymavlink>=2.4.50,<3'],
        'blackbox': ['orangebox>=0.4,<0.5']}

setup(
    name=NAME,
    version='0.2.0',
    packages=find_packages(include=[NAME, NAME + '.*']),
    package_data={NAME: ['py.typed'], NAME + '.report': ['*.css', '*.js'],
                  NAME + '.nodes': ['*.html']},
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        (SHARE, ['package.xml']),
        (SHARE + '/launch', glob('launch/*_launch.py')),
        (SHARE + '/config', glob('config/*.yaml')),
        (SHARE + '/msg_config', glob('msg_config/*.yaml')),
        (SHARE + '/layouts', glob('layouts/*')),
        (SHARE + '/deploy', glob('deploy/*')),
        (SHARE + '/security', glob('security/*.xml')),
    ],
    # The bounds are those of scripts/requirements-*.txt; test_package.py compares them.
    install_requires=['numpy>=1.26.4,<3', 'scipy>=1.11.4,<2', 'PyYAML>=6.0.1,<7', 'mcap>=1.1.0,<2',
                      'mcap-ros2-support>=0.5.0,<0.7'],
    extras_require={
        'fast': ['numba>=0.59,<1'],
        'fleet': ['dask>=2024.8,<2027', 'distributed>=2024.8,<2027', 'pyarrow>=16,<28'],
        'live': ['tornado>=6.4,<7'],
        'test': ['pytest>=8,<10', 'hypothesis>=6.100,<7', 'rosbags>=0.11,<0.12'],
        'doc': ['sphinx>=7.2,<10', 'myst-parser>=3,<6'],
        **LOGS, 'logs': [package for packages in LOGS.values() for package in packages]},
    python_requires='>=3.11',
    # The message descriptions are read as files beside the package.
    zip_safe=False,
    url='https://ou-monitor.example.org',
    author='ou_monitor maintainers',
    author_email='maintainers@ou-monitor.example.org',
    maintainer='ou_monitor maintainers',
    maintainer_email='maintainers@ou-monitor.example.org',
    description='Onboard noise-aware state estimation for UAV supply rails.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'ou-monitor = ou_monitor.cli.main:main',
            'estimator = ou_monitor.nodes.estimator:main',
            'adaptive_filter = ou_monitor.nodes.adaptive_filter:main',
            'adc = ou_monitor.nodes.adc:main',
            'replay = ou_monitor.nodes.replay:main',
        ],
    },
)
