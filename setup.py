"""Package for ament_python (colcon) and for pip; the offline half needs no ROS."""

from glob import glob

from setuptools import find_packages, setup

NAME = 'ou_monitor'
SHARE = 'share/' + NAME

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, NAME + '.*']),
    data_files=[
        ('share/ament_index/resource_index/packages', ['resource/' + NAME]),
        (SHARE, ['package.xml']),
        (SHARE + '/launch', glob('launch/*_launch.py')),
        (SHARE + '/config', glob('config/*.yaml')),
        (SHARE + '/msg_config', glob('msg_config/*.yaml')),
    ],
    install_requires=['numpy', 'scipy', 'PyYAML', 'mcap', 'mcap-ros2-support'],
    extras_require={'fast': ['numba'], 'test': ['pytest', 'hypothesis', 'rosbags']},
    python_requires='>=3.11',
    # The message descriptions are read as files beside the package.
    zip_safe=False,
    maintainer='ou_monitor maintainers',
    maintainer_email='maintainers@ou-monitor.example.org',
    description='Onboard noise-aware state estimation for UAV supply rails.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'ou-monitor = ou_monitor.cli.main:main',
            'estimator = ou_monitor.nodes.estimator:main',
            'adaptive_filter = ou_monitor.nodes.adaptive_filter:main',
            'replay = ou_monitor.nodes.replay:main',
        ],
    },
)
