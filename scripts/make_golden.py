#!/usr/bin/env python3
"""
Write the golden tables: `scripts/make_golden.py [NAME or RUN ...]` (default: those there are).

test/analysis/golden/NAME.json is the output of `ou-monitor analyze bags/NAME --json -`, with only
every sixteenth value of long series; test/golden/RUN.json is the result of a run of
test/support/golden_*.py.  Run this script after a change that is meant to change numbers, and look
at the differences before you commit them.
"""

from __future__ import annotations

import json
from pathlib import Path
import sys
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ou_monitor.analysis.analyze import Analysis, analyze, as_data  # noqa: E402
from ou_monitor.recordings.read import read_recording  # noqa: E402
from ou_monitor.records import plain_data  # noqa: E402

BAGS = ROOT / 'bags'
GOLDEN = ROOT / 'test' / 'analysis' / 'golden'
# Series longer than this are thinned.
_LONG, _EVERY = 64, 16


def table(analysis: Analysis) -> Any:
    """
    Return the golden table of a bag's analysis.

    Parameters
    ----------
    analysis : Analysis
        Result of `analyze`.

    Returns
    -------
    object
        Plain data.

    """
    data = as_data(analysis)
    # The source is the path that was passed, which differs between machines.
    del data['source']
    # From the load filter, which has its own tests.
    del data['overview']
    return thinned(plain_data(data))


def thinned(value: Any) -> Any:
    """Return plain data with every sixteenth value of its long lists, to nine digits."""
    if isinstance(value, dict):
        return {key: thinned(item) for key, item in value.items()}
    if isinstance(value, list):
        return [thinned(item) for item in (value[::_EVERY] if len(value) > _LONG else value)]
    # Further digits differ between machines.
    return float(f'{value:.9g}') if isinstance(value, float) else value


def main(argv: list[str]) -> int:
    """Write the tables of the bags named."""
    sys.path.insert(1, str(ROOT / 'test' / 'support'))
    import golden_models
    import golden_parts
    import golden_runs
    runs = {**golden_runs.RUNS, **golden_models.RUNS, **golden_parts.RUNS}
    bags = sorted(path.stem for path in GOLDEN.glob('*.json'))
    for name in argv or [*bags, *runs]:
        found = runs[name]() if name in runs else table(
            analyze(read_recording(BAGS / name)))
        path = (ROOT / 'test' / 'golden' if name in runs else GOLDEN) / f'{name}.json'
        # Only programs read the table of a run: one line for each part is enough.
        text = json.dumps(found, indent=None if name in runs else 1, allow_nan=False,
                          ensure_ascii=False)
        path.write_text(text.replace('}, {', '},\n{') + '\n', encoding='utf-8')
        print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
