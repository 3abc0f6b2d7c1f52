"""What a matrix of rates must be to generate an irreducible Markov chain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.sparse.csgraph import connected_components

# A row may miss zero by this share of the largest rate: rounding of the input.
ROW_TOLERANCE = 1e-9


def _named(states: Sequence[int] | npt.NDArray[np.intp]) -> str:
    """Return ``state 2`` or ``states 0, 3``, cut where there are many."""
    names = [str(int(state)) for state in states]
    said = ', '.join(names[:8]) + (', ...' if len(names) > 8 else '')
    return ('state ' if len(names) == 1 else 'states ') + said


def check_rates(q: FloatArray) -> None:
    """Refuse what is no generator at all (q in 1/s)."""
    if q.ndim != 2 or q.shape[0] != q.shape[1]:
        raise ValueError(f'Q must be square, got shape {q.shape}')
    if len(q) < 2:
        raise ValueError('Q must have two states or more: one state never switches')
    if not np.isfinite(q).all():
        row, column = np.argwhere(~np.isfinite(q))[0]
        raise ValueError(f'Q[{row}, {column}] is {q[row, column]}: rates must be finite, 1/s')
    off = q - np.diag(np.diag(q))
    if (off < 0.0).any():
        row, column = np.unravel_index(np.argmin(off), q.shape)
        raise ValueError(
            f'Q[{row}, {column}] = {q[row, column]:g} 1/s is negative: only the diagonal may be')
    largest = float(np.abs(q).max())
    defect = q.sum(axis=1)
    row = int(np.argmax(np.abs(defect)))
    if abs(defect[row]) > ROW_TOLERANCE * largest:
        raise ValueError(
            f'row {row} of Q sums to {defect[row]:.6g} 1/s, not to 0 (tolerance '
            f'{ROW_TOLERANCE * largest:.3g} 1/s): its diagonal entry should be '
            f'{-off[row].sum():.6g}')


def check_classes(rates: FloatArray) -> None:
    """Refuse chains that do not visit every state for ever (rates in 1/s)."""
    absorbing = np.flatnonzero(rates.sum(axis=1) == 0.0)
    if absorbing.size:
        raise ValueError(f'{_named(absorbing)} absorbing: no rate leaves, so the switching stops')
    count, label = connected_components(rates > 0.0, directed=True, connection='strong')
    if count == 1:
        return
    leaks = (rates > 0.0) & (label[:, None] != label[None, :])
    closed = [c for c in range(count) if not leaks[label == c].any()]
    if len(closed) > 1:
        classes = '; '.join(_named(np.flatnonzero(label == c)) for c in closed[:4])
        raise ValueError(
            f'the chain falls apart into {len(closed)} closed classes ({classes}): it has no '
            'single stationary law; give each class its own generator')
    transient = np.flatnonzero(label != closed[0])
    raise ValueError(
        f'{_named(transient)} transient: left once and for all; give the generator of the '
        'other states')
