"""
Drop the repeats of loggers that are faster than their source.

Limits first: where repeats come at no steady distance, those of the logger are
not told from two readings that agree; then nothing is dropped, unless every
repeat is to go, which selects changes and makes noise look larger.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from ou_monitor.online.estimator.repeats import refresh_period, Repeats, whole
from ou_monitor.recordings.importers.log import Series


def drop_held(series: Series, *, every: bool = False) -> tuple[Series, str]:
    """Return a series without repeats, and one sentence on what was done."""
    share = series.repeats
    period = refresh_period(series.values) if series.n > 1 else 1.0
    batch = whole(np.stack([series.t, series.values, np.full(series.n, np.nan)]))
    if period > 1.0 and batch is not None:
        repeats = Repeats()
        repeats.period = period
        batch = repeats.drop(batch)
    if period > 1.0 and batch is not None:
        kept = replace(series, t=batch.t, values=batch.y)
        words = (f'refreshed every {period:.4g} samples: {series.n - kept.n} of {series.n} '
                 'held samples dropped')
    elif every and share > 0.0:
        fresh = np.ones(series.n, dtype=bool)
        fresh[1:] = np.diff(series.values) != 0.0
        kept = replace(series, t=series.t[fresh], values=series.values[fresh])
        words = (f'{series.n - kept.n} of {series.n} repeats dropped; they come at no steady '
                 'distance, so readings that agree went too')
    else:
        kept = series
        words = (f'nothing dropped: {share:.0%} of the increments are zero, at no steady distance'
                 if share > 0.0 else 'nothing dropped: no sample repeats the one before')
    return kept, f'{series.name}: {words}.'
