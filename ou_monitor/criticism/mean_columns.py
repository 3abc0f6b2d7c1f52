"""
The mean of the voltage: the columns that terms add to it, and their coefficients.

Columns are computed once for a recording: parts that begin with it share them, and what was put
side by side last is kept, as fits of the noise ask for the same again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.terms.ac_coupling import ACCoupling
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.segment import Segment
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray


def coefficients(term: Term) -> list[float]:
    """Return the coefficients of a term's columns."""
    if isinstance(term, OU):
        return [term.u0]
    return term.linear_values() if term.ROLE is Role.MEAN else []


def columns_of(samples: Samples, terms: Sequence[Term], s: Segment) -> FloatArray:
    """Return all columns of the mean, through the instrument."""
    return design_of(samples, terms, s)[:, 1:]


def design_of(samples: Samples, terms: Sequence[Term], s: Segment) -> FloatArray:
    """Return the voltage and all columns of the mean; as they were where they are the same."""
    means = _means(terms)
    key = tuple(term.with_linear([1.0] * len(term.LINEAR)) for term in means)
    if key not in samples.designs:
        samples.designs.clear()
        samples.designs[key] = np.concatenate([
            samples.voltage[:, None], np.ones((samples.n, 1)), *map(samples.columns, means)],
            axis=1)
    design = samples.designs[key]
    for term in terms:
        if isinstance(term, ACCoupling):
            design = design.copy()
            # What the instrument shows has a level of its own.
            design[:, 2:] = term.pass_through(design[:, 2:], s)
    return design


def _means(terms: Sequence[Term]) -> tuple[Term, ...]:
    return tuple(term for term in terms if term.ROLE is Role.MEAN and term.NAME != 'ou')


def mean_of(samples: Samples, terms: Sequence[Term], s: Segment) -> FloatArray:
    """Return the mean of the voltage, V; as it was where only the noise has changed."""
    beta = np.array([value for term in terms for value in coefficients(term)])
    if any(isinstance(term, ACCoupling) for term in terms):
        return np.asarray(columns_of(samples, terms, s) @ beta)
    key = (*beta.tolist(), *_means(terms))
    if key not in samples.means:
        samples.means.clear()
        samples.means[key] = columns_of(samples, terms, s) @ beta
    return samples.means[key]


def owners(terms: Sequence[Term]) -> list[Term | None]:
    """Return the term of each column of the mean; None for the level."""
    return [None, *(term for term in terms if term.ROLE is Role.MEAN and term.NAME != 'ou'
                    for _ in term.LINEAR)]


def solved(columns: FloatArray, y: FloatArray) -> FloatArray:
    """Return least squares; coefficients that nothing determines come out as small as may be."""
    # By the normal equations: scaled, columns here are never so alike that it matters, and
    # least squares by orthogonal factors take ten times as long.
    scale = np.sqrt(np.einsum('ij,ij->j', columns, columns))
    scale[scale == 0.0] = 1.0
    gram = columns.T @ columns / np.outer(scale, scale)
    inverse = np.asarray(np.linalg.pinv(gram, rcond=1e-12, hermitian=True), dtype=np.float64)
    many: FloatArray = inverse @ (
        columns.T @ y / scale) / scale
    return many


def with_mean(terms: tuple[Term, ...], beta: FloatArray) -> tuple[Term, ...]:
    """Return terms with the coefficients of all columns of the mean."""
    ou = terms[0]
    assert isinstance(ou, OU)
    result: list[Term] = [replace(ou, u0=float(beta[0]))]
    at = 1
    for term in terms[1:]:
        if isinstance(term, ACCoupling):
            term = replace(term, offset=float(beta[0]))
        size = len(term.LINEAR) if term.ROLE is Role.MEAN else 0
        result.append(term.with_linear(beta[at:at + size].tolist()) if size else term)
        at += size
    return tuple(result)
