"""
Where a fit with one more latent state starts: from the spectrum of the scores of the model so far.

Another state lifts the ordinates of that periodogram by the ratio of two spectra.  Samples that
are few enough for a filter are too short to hold a slow state; the spectrum has all of them.

Limits: where throttle moves alpha, sigma or the white noise, their means stand for them, those of
sigma^2 and the noise harmonic, as they weigh the scores; steps between samples count as even.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import driven, state_space, white_noise
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.whittle import Ordinates
from ou_monitor.records import FloatArray


def from_spectrum(samples: Samples, composite: Composite, starts: Sequence[Term]
                  ) -> tuple[tuple[Term, ...], float]:
    """
    Return the terms of a model and more of them, fitted to the spectrum of its scores.

    starts are the terms of `composite` without its laws, the `ou` as it should begin, and more
    of them at the end.  The second result is the gain of the fit, nats.
    """
    ordinates = Ordinates.of(composite.z[samples.train])
    spectrum = _Spectrum(samples, composite.gaussian.terms, ordinates.omega)
    free = [(k, name) for k, term in enumerate(starts) if k == 0 or term.ROLE in (
        Role.BLOCK, Role.NOISE) for name in term.free()]
    before = spectrum.of(composite.gaussian.terms)

    def terms_at(x: FloatArray) -> tuple[Term, ...]:
        found = list(starts)
        for (k, name), by in zip(free, x.tolist(), strict=True):
            try:
                found[k] = found[k].moved(name, by)
            except ValueError:
                # As far as its range goes.
                continue
        return tuple(found)

    x, gain = ordinates.climb(lambda x: np.log(spectrum.of(terms_at(x)) / before),
                              np.zeros(len(free)))
    return terms_at(x), gain


class _Spectrum:
    """What models say of a spectrum, what throttle does to alpha, sigma and noise as in one."""

    def __init__(self, samples: Samples, terms: Sequence[Term], omega: FloatArray) -> None:
        self._turn = np.exp(1j * omega)
        step = float(np.median(samples.step[1:]))
        self._few = Samples(step * np.arange(3.0), np.zeros(3), None)
        ou = terms[0]
        assert isinstance(ou, OU)
        s = driven(samples, terms)
        self._faster = math.exp(float(np.mean(np.log(s.alpha / ou.alpha))))
        self._louder = 1.0 / math.sqrt(float(np.mean((ou.sigma / s.sigma) ** 2)))
        self._blur = samples.blur
        noise = samples.blur + sum(term.variance() for term in terms)
        each = white_noise(samples, terms, s)
        self._noisier = 1.0 / float(np.mean(noise / each)) if noise > 0.0 else 1.0

    def of(self, terms: Sequence[Term]) -> FloatArray:
        """Return the spectrum of a model, up to a factor."""
        ou = terms[0]
        assert isinstance(ou, OU)
        ou = replace(ou, alpha=ou.alpha * self._faster, sigma=ou.sigma * self._louder)
        kept = [term for term in terms[1:] if term.ROLE is Role.BLOCK]
        space = state_space(self._few, [ou, *kept], None)[1]
        f, q, h = space.f[1], space.q[1], space.h
        left = self._turn[:, None, None] * np.eye(h.size) - f
        seen = np.linalg.solve(left.transpose(0, 2, 1), np.broadcast_to(
            h[:, None], (self._turn.size, h.size, 1)))[..., 0]
        noise = self._blur + sum(
            term.variance() for term in terms[1:] if term.ROLE is Role.NOISE)
        found: FloatArray = np.einsum('ki,ij,kj->k', seen.conj(), q, seen).real
        return found + noise * self._noisier
