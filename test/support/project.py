"""Lists of the project's files, for tests that read or copy all of them; recordings of others."""

from functools import cache
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
