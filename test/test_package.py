"""What users install: a colcon package, a pip package, and scripts that set up both."""

from collections.abc import Iterator
from email.utils import parseaddr
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tarfile
import time
import tomllib
import venv
import xml.etree.ElementTree as ElementTree
import zipfile

from catkin_pkg.changelog import get_changelog_from_path
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from project import metadata, project_files, ROOT
import pytest

PYPROJECT = tomllib.loads((ROOT / 'pyproject.toml').read_text(encoding='utf-8'))
EXECUTABLES = [
    'adaptive_filter', 'adc', 'estimator', 'ou-monitor', 'replay', 'supply_simulator']
SHARED = ('msg_config', 'launch', 'config', 'layouts', 'security', 'deploy')
# Starting Python, ROS and DDS on a busy machine.
START_TIMEOUT = 60.0
DOMAIN = '60'


def clean_environment(**extra: str) -> dict[str, str]:
    """Return the environment without what would let the source tree be found by chance."""
    # The bootstrapper of the ROS wheels leaves its mark in a process that it has set up.
    kept = {key: value for key, value in os.environ.items()
            if key != '_ROS_WHEELS_BOOTSTRAP_COMPLETE'}
    path = kept.pop('PYTHONPATH', '').split(os.pathsep)
    rest = [place for place in path if place and Path(place).resolve() != ROOT]
    return kept | ({'PYTHONPATH': os.pathsep.join(rest)} if rest else {}) | extra


def run(*command: object, **options: object) -> subprocess.CompletedProcess:
    """Run a command to its end, outputs as text."""
    options.setdefault('env', clean_environment())
    return subprocess.run([str(word) for word in command], capture_output=True, text=True,
                          timeout=300, **options)


@pytest.fixture(scope='module')
def tree(tmp_path_factory) -> Path:
    """Return a copy of the project's files, in a folder with a space in its name."""
    copy = tmp_path_factory.mktemp('some folder') / 'ou monitor'
    for path in project_files():
        target = copy / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, target)
    return copy


@pytest.fixture(scope='module')
def python(tmp_path_factory) -> Path:
    """Return the interpreter under a name that a script's first line can hold (no spaces)."""
    if ' ' not in sys.executable:
        return Path(sys.executable)
    link = tmp_path_factory.mktemp('python') / 'environment'
    link.symlink_to(sys.prefix)
    return link / 'bin' / Path(sys.executable).name


def colcon(python: Path, workspace: Path, *arguments: object) -> subprocess.CompletedProcess:
    return run(python, '-m', 'colcon', '--log-base', workspace / 'log', *arguments,
               cwd=workspace)


@pytest.fixture(scope='module', params=[[], ['--symlink-install']], ids=['copied', 'symlinked'])
def installed(request, tree, python, tmp_path_factory) -> Path:
    """Return the package's folder in a colcon workspace's install space."""
    workspace = tmp_path_factory.mktemp('workspace')
    shutil.copytree(tree, workspace / 'src' / 'ou_monitor')
    done = colcon(python, workspace, 'build', *request.param)
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / 'install' / 'ou_monitor'


def test_colcon_recognises_the_package(tree, python):
    assert colcon(python, tree, 'list').stdout.split() == ['ou_monitor', '.', '(ros.ament_python)']


def test_colcon_installs_what_ros2_looks_for(installed):
    """Executables, index entry, message descriptions, launch and parameter files are there."""
    assert sorted(os.listdir(installed / 'lib' / 'ou_monitor')) == EXECUTABLES
    share = installed / 'share'
    assert (share / 'ament_index/resource_index/packages/ou_monitor').exists()
    for folder in SHARED:
        expected = {path.name for path in (ROOT / folder).iterdir() if path.is_file()}
        assert expected and set(os.listdir(share / 'ou_monitor' / folder)) == expected


def environment_of(installed: Path, python: Path) -> dict[str, str]:
    """Return the environment that the workspace's own setup file makes."""
    done = run('bash', '-c', 'source "$0" && env -0', installed.parent / 'local_setup.bash',
               env=clean_environment(ROS_DOMAIN_ID=DOMAIN, COLCON_PYTHON_EXECUTABLE=str(python),
                                     ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'))
    assert done.returncode == 0, done.stderr
    return dict(word.split('=', 1) for word in done.stdout.split('\0') if '=' in word)


@pytest.fixture
def listener() -> Iterator[object]:
    """Yield a node of another process than the one under test, in the same domain."""
    import rclpy
    from rclpy.context import Context
    context = Context()
    rclpy.init(context=context, domain_id=int(DOMAIN))
    node = rclpy.create_node('listener', context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_installed_estimator_starts_and_stops(installed, python, listener, tmp_path):
    """The installed executable takes ROS arguments, is seen over DDS and ends on SIGINT."""
    log = tmp_path / 'estimator.log'
    with log.open('wb') as out:
        process = subprocess.Popen(
            [installed / 'lib/ou_monitor/estimator', '--ros-args', '-p', 'publish_rate:=5.0'],
            cwd=tmp_path, env=environment_of(installed, python), stdout=out, stderr=out)
    try:
        deadline = time.monotonic() + START_TIMEOUT
        while '/ou_estimator/state' not in dict(listener.get_topic_names_and_types()):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(START_TIMEOUT) == 0, log.read_text()
        assert 'Traceback' not in log.read_text()
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope='module')
def offline(tree, tmp_path_factory) -> Path:
    """Return the bin folder of an environment without ROS, with the wheel of the project."""
    folder = tmp_path_factory.mktemp('no ros')
    done = run(sys.executable, '-m', 'pip', 'wheel', '--quiet', '--no-deps',
               '--no-build-isolation', '--wheel-dir', folder, tree)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob('ou_monitor-*.whl')
    venv.create(folder / 'venv', with_pip=False, symlinks=True)
    python = folder / 'venv/bin/python'
    site = Path(run(python, '-c', 'import sysconfig; print(sysconfig.get_path("purelib"))')
                .stdout.strip())
    # What pip would fetch, without the network: links to the packages that are here already.
    here = [Path(sysconfig.get_path('purelib')), Path(sysconfig.get_path('platlib'))]
    for name in ('numpy', 'numpy.libs', 'scipy', 'scipy.libs', 'yaml', '_yaml', 'mcap',
                 'mcap_ros2', 'lz4', 'zstandard', 'zstandard.libs', 'mcap_ros2_support'):
        for source in {place / name for place in here if (place / name).exists()}:
            (site / name).symlink_to(source)
    done = run(sys.executable, '-m', 'pip', '--python', python, 'install', '--quiet', '--no-deps',
               '--no-index', '--disable-pip-version-check', wheel)
    assert done.returncode == 0, done.stderr
    return folder / 'venv/bin'


def contents(archive: Path) -> set[str]:
    """Return the files of a wheel, or of an sdist without its leading folder."""
    if archive.suffix == '.whl':
        return set(zipfile.ZipFile(archive).namelist())
    with tarfile.open(archive) as file:
        return {name.partition('/')[2] for name in file.getnames()}


def check_archives(folder: Path, tree: Path) -> None:
    """Check an sdist and the wheel that was made of it: all that is needed, and no tests."""
    (wheel,), (sdist,) = folder.glob('*.whl'), folder.glob('*.tar.gz')
    own = {str(path.relative_to(tree)) for path in (tree / 'ou_monitor').rglob('*')
           if path.is_file() and '__pycache__' not in path.parts}
    shared = {f'{name}/{path.name}' for name in SHARED for path in (tree / name).iterdir()
              if path.is_file()}
    made, source = contents(wheel), contents(sdist)
    data = f'{wheel.name.rsplit("-", 3)[0]}.data/data/share'
    assert own == {name for name in made if name.startswith('ou_monitor/')}
    assert made >= {f'{data}/ou_monitor/{name}' for name in {*shared, 'package.xml'}}
    assert f'{data}/ament_index/resource_index/packages/ou_monitor' in made
    assert source >= own | shared | {'package.xml', 'pyproject.toml', 'setup.py', 'setup.cfg',
                                     'README.md', 'LICENSE', 'resource/ou_monitor'}
    assert not any(name.startswith('test') for name in made)
    with zipfile.ZipFile(wheel) as file:
        (points,) = (name for name in made if name.endswith('entry_points.txt'))
        assert sorted(re.findall(r'^([\w-]+) =', file.read(points).decode(), re.M)) == EXECUTABLES
        (about,) = (name for name in made if name.endswith('METADATA'))
        said = file.read(about).decode()
    assert 'License: Apache-2.0' in said and 'Requires-Python: >=3.11' in said


def test_sdist_and_wheel(tree, tmp_path):
    """The hooks that pip and `python -m build` call; the wheel is made of the sdist."""
    hook = 'import sys, setuptools.build_meta as b; getattr(b, sys.argv[1])(sys.argv[2])'
    source = tmp_path / 'source'
    shutil.copytree(tree, source)
    done = run(sys.executable, '-c', hook, 'build_sdist', tmp_path, cwd=source)
    assert done.returncode == 0, done.stderr
    (sdist,) = tmp_path.glob('*.tar.gz')
    with tarfile.open(sdist) as file:
        file.extractall(tmp_path / 'unpacked', filter='data')
    (unpacked,) = (tmp_path / 'unpacked').iterdir()
    done = run(sys.executable, '-c', hook, 'build_wheel', tmp_path, cwd=unpacked)
    assert done.returncode == 0, done.stderr
    check_archives(tmp_path, tree)


def python311() -> str:
    """Return a Python 3.11, the one of Debian 12; the test is skipped where there is none."""
    found = [sys.executable] if sys.version_info[:2] == (3, 11) else []
    root = Path(os.environ.get('PYENV_ROOT', Path.home() / '.pyenv'))
    found += [*map(str, sorted(root.glob('versions/3.11.*/bin/python3.11'))),
              shutil.which('python3.11') or '']
    for one in filter(None, found):
        if run(one, '-c', 'import ensurepip, venv').returncode == 0:
            return one
    pytest.skip('no Python 3.11 with venv')


def fetched(python: Path, *packages: str) -> None:
    """Install packages from the registry; the test is skipped where there is none."""
    done = run(python, '-m', 'pip', '--disable-pip-version-check', 'install', '--quiet',
               '--retries', '1', '--timeout', '20', *packages)
    if done.returncode and re.search('NewConnectionError|No matching distribution|timed out',
                                     done.stdout + done.stderr):
        pytest.skip('no package registry is reachable')
    assert done.returncode == 0, done.stderr


def test_pip_of_debian_12_puts_the_command_on_the_path(tree, tmp_path):
    """Python 3.11, pip 23.0, no wheel; `pip install .` builds in an environment of its own."""
    assert run(python311(), '-m', 'venv', tmp_path / 'venv').returncode == 0
    python = tmp_path / 'venv/bin/python'
    fetched(python, 'pip==23.0.*')
    done = run(python, '-c', 'import wheel')
    assert done.returncode == 1, 'wheel is there'
    source = tmp_path / 'source'
    shutil.copytree(tree, source)
    done = run(python, '-m', 'pip', 'install', '--no-deps', '.', cwd=source)
    assert done.returncode == 0, done.stdout + done.stderr
    assert set(EXECUTABLES) <= set(os.listdir(tmp_path / 'venv/bin'))
    assert not (tmp_path / 'venv/lib/ou_monitor').exists()
    assert (tmp_path / 'venv/share/ou_monitor/msg_config').is_dir()
    shown = run(python, '-c', 'import ou_monitor; print(ou_monitor.__file__)', cwd=tmp_path)
    assert Path(shown.stdout.strip()).is_relative_to(tmp_path / 'venv/lib'), shown.stderr


def test_pip_gives_the_offline_half(offline, tmp_path):
    """The command and the import work where there is no ROS."""
    shown = run(offline / 'ou-monitor', '--help', cwd=tmp_path)
    assert shown.returncode == 0 and 'analyze' in shown.stdout, shown.stderr
    code = ('import sys, ou_monitor; from ou_monitor import SlidingEstimator as S; '
            'S(window=2.0).estimate(); print(ou_monitor.__file__); '
            'sys.exit("rclpy" in sys.modules)')
    done = run(offline / 'python', '-c', code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(offline.parent)


def test_pip_installs_the_message_descriptions(offline, tmp_path):
    code = 'from ou_monitor.stream.config import list_msg_configs as f; print(*f())'
    done = run(offline / 'python', '-c', code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == sorted(path.stem for path in ROOT.glob('msg_config/*.yaml'))


def test_changelog_is_of_this_version():
    released = list(get_changelog_from_path(str(ROOT)).foreach_version(reverse=True))
    version = ElementTree.parse(ROOT / 'package.xml').getroot().findtext('version')
    assert str(released[0][0]) == version
    assert all(date and content for _, date, content in released)
    # What catkin_prepare_release renames; it may be empty, and stands first.
    titles = re.findall(r'^(.+)\n-+$', (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8'),
                        re.MULTILINE)
    assert titles[0] == 'Forthcoming' and titles[1].startswith(f'{version} (')


@pytest.mark.parametrize('name', ['adaptive_filter', 'estimator', 'replay'])
def test_nodes_without_ros_say_so(offline, tmp_path, name):
    done = run(offline / name, *(['some.mcap'] if name == 'replay' else []), cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and 'ROS 2' in done.stderr


def test_the_installed_analyze_reads_a_bag(offline, tmp_path):
    done = run(offline / 'ou-monitor', 'analyze', ROOT / 'bags' / 'load_10', '--json', '-',
               '--report', tmp_path / 'r.html', cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    html = (tmp_path / 'r.html').read_text()
    assert 'class="plot-data"' in html and 'class LivePlot' in html and '.live-view' in html


def test_package_xml_agrees_with_the_metadata(tree):
    package = ElementTree.parse(ROOT / 'package.xml').getroot()
    asked = run(sys.executable, 'setup.py', '--quiet', '--name', '--version', '--license',
                cwd=tree)
    maintainer = package.find('maintainer').get('email')
    assert asked.stdout.split() == [
        package.findtext('name'), package.findtext('version'), package.findtext('license'),
    ], asked.stderr
    assert [one['email'] for one in metadata()['maintainers']] == [maintainer]
    assert parseaddr(maintainer)[1] == maintainer and re.fullmatch(r'[^@\s]+@[^@\s]+\.\w+',
                                                                   maintainer)
    assert package.findtext('license') == 'Apache-2.0'
    assert 'Version 2.0, January 2004' in (ROOT / 'LICENSE').read_text(encoding='utf-8')


def test_requirements_agree_with_the_metadata():
    listed = [line for line in (ROOT / 'scripts/requirements-run.txt').read_text().splitlines()
              if line and not line.startswith('#')]
    assert sorted(metadata()['dependencies']) == sorted(listed)
    assert all('>=' in line and ',<' in line for line in listed)
    # What apt installs for a colcon workspace has the same bounds.
    names = {'numpy': 'numpy', 'scipy': 'scipy', 'PyYAML': 'yaml'}
    depends = {element.text: f">={element.get('version_gte')},<{element.get('version_lt')}"
               for element in ElementTree.parse(ROOT / 'package.xml').iter('exec_depend')}
    for line in listed:
        name = re.match(r'[\w-]+', line).group()
        assert name not in names or depends[f'python3-{names[name]}'] == line[len(name):]


def requirements(name: str) -> list[Requirement]:
    """Return what a list in scripts/ asks for."""
    text = (ROOT / f'scripts/{name}').read_text(encoding='utf-8')
    # A lock has the hashes of a package on lines of their own.
    return [Requirement(line.rstrip('\\')) for line in text.splitlines()
            if line and not line.startswith(('#', ' '))]


LISTS = {'build': ['build'], 'run': ['build', 'ros', 'run', 'live'],
         'test': ['build', 'ros', 'run', 'live', 'ros-test', 'test']}


@pytest.mark.parametrize('python', ['3.11.0', '3.12.0'])
@pytest.mark.parametrize('level', LISTS)
def test_locks_are_within_the_bounds(level, python):
    here = {'python_version': python[:4], 'python_full_version': python, 'sys_platform': 'linux',
            'platform_machine': 'x86_64'}
    locked: dict[str, str] = {}
    for one in requirements(f'{level}.lock'):
        (pin,) = one.specifier
        assert pin.operator == '=='
        if one.marker is None or one.marker.evaluate(here):
            assert locked.setdefault(canonicalize_name(one.name), pin.version) == pin.version
    for name in LISTS[level]:
        for one in requirements(f'requirements-{name}.txt'):
            assert {spec.operator for spec in one.specifier} in ({'>=', '<'}, {'=='}), one
            assert one.specifier.contains(locked[canonicalize_name(one.name)]), one


def test_noble_is_the_lowest_of_the_bounds():
    """The versions of Ubuntu 24.04 are the lower bounds, and the lock has them and a tool's."""
    lowest = {one.name: spec.version for one in requirements('requirements-run.txt')
              for spec in one.specifier if spec.operator == '>='}
    wanted = {one.name: next(iter(one.specifier)).version
              for one in requirements('requirements-noble.txt')}
    assert len(wanted) == 4 and wanted.items() - lowest.items() == {('pyarrow', '25.0.0')}
    assert {canonicalize_name(one.name): next(iter(one.specifier)).version
            for one in requirements('noble.lock')} == {
                canonicalize_name(name): version for name, version in wanted.items()}


@pytest.mark.parametrize('level', [*LISTS, 'noble'])
def test_locks_have_hashes_and_no_host(level):
    """Every package of a lock has a SHA-256, and no line says where it was fetched from."""
    text = (ROOT / f'scripts/{level}.lock').read_text(encoding='utf-8')
    packages = re.split(r'\n(?=\S)', text.strip())[1:]
    assert len(packages) == len(requirements(f'{level}.lock')) >= 2
    assert all(re.search(r'--hash=sha256:[0-9a-f]{64}\b', package) for package in packages)
    assert not re.search(r'://|index-url|find-links|trusted-host', text)


def test_extras_have_the_bounds_of_the_test_list():
    listed = {one.name: one.specifier for one in requirements('requirements-test.txt')}
    extras = metadata()['optional-dependencies']
    declared = [Requirement(text) for name in extras for text in extras[name] if name != 'logs']
    found = {one.name: one.specifier for one in declared}
    (build,) = map(Requirement, PYPROJECT['build-system']['requires'])
    assert build in requirements('requirements-build.txt')
    assert {'pyulog', 'orangebox', 'dask', 'distributed', 'pyarrow', 'pytest'} <= set(found)
    assert all({s.operator for s in specifier} == {'>=', '<'} for specifier in found.values())
    for name in set(found) & set(listed):
        assert found[name] == listed[name], name
