"""Lists of the project's files, for tests that read or copy all of them; recordings of others."""

from functools import cache
import math
import os
from pathlib import Path
import subprocess
import tomllib
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Recordings of others are not shipped.
REAL = Path(os.environ.get('OU_MONITOR_REALDATA', 'nowhere'))
needs_recordings = pytest.mark.skipif(
    not REAL.is_dir(), reason='OU_MONITOR_REALDATA names no folder of recordings')
# Files made by running the project, for an unpacked archive, where git cannot tell.
GENERATED = {'.venv', '.venv-noble', 'build', 'install', 'log', 'out', '__pycache__', '.git',
             '.hypothesis', '.pytest_cache', '.mypy_cache', 'ou_monitor.egg-info'}


@cache
def recorded(path: Path, **options: Any) -> Any:
    """Return a recording that many tests use, read once per process."""
    from ou_monitor.recordings.read import read_recording
    return read_recording(path, **options)


def metadata() -> dict[str, Any]:
    """Return the table [project] of pyproject.toml."""
    return tomllib.loads((ROOT / 'pyproject.toml').read_text(encoding='utf-8'))['project']


def project_files() -> list[Path]:
    """Return the files of the project: those that git tracks or would track."""
    listed = subprocess.run(
        ['git', 'ls-files', '--cached', '--others', '--exclude-standard', '-z'],
        cwd=ROOT, capture_output=True, check=False)
    if (ROOT / '.git').exists() and listed.returncode == 0:
        names = listed.stdout.decode().split('\0')
        return [ROOT / name for name in names if name and (ROOT / name).is_file()]
    return [path for path in ROOT.rglob('*')
            if path.is_file() and not GENERATED & set(path.relative_to(ROOT).parts)]


def differences(found: Any, wanted: Any, relative: float, absolute: float,
                where: str = '') -> list[str]:
    """Return the places at which two tables differ by more than the tolerances."""
    if isinstance(wanted, dict) and isinstance(found, dict) and found.keys() == wanted.keys():
        return [line for key in wanted for line in differences(
            found[key], wanted[key], relative, absolute, f'{where}/{key}')]
    if isinstance(wanted, list) and isinstance(found, list) and len(found) == len(wanted):
        return [line for k, (a, b) in enumerate(zip(found, wanted))
                for line in differences(a, b, relative, absolute, f'{where}[{k}]')]
    number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in (found, wanted))
    same = (math.isclose(found, wanted, rel_tol=relative, abs_tol=absolute) if number
            else found == wanted)
    return [] if same else [f'{where}: {found}, not {wanted}']
