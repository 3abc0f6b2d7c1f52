"""
What the search decides: which causes are tried, accepted, kept, withdrawn.

Pure functions of statistics (normal scores by name), evidence (nats) and the attributes of the
causes; this module fits nothing.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
import math
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.battery import is_sign
from ou_monitor.criticism.innovations import OtherPole
from ou_monitor.model.terms.ac_coupling import ACCoupling
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_answer import LoadSag, LoadTransient
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.model.terms.term import Role, Term

Statistics = Mapping[str, float]
Kind = type[Term]

# A statistic beyond this asks for the terms that it is a sign of: by chance one of a hundred
# does (P(|z| > 2.6) = 0.9 %, as `FAMILY_WISE`), and a needless trial costs only time.
ASK = 2.6
# The same for terms that take seconds to fit: one of 700.
ASK_DEAR = 3.2
# A statistic beyond this shows that the model is wrong: of 70, one by chance in 700 recordings
# (`family_chance`; 15 of 8700 simulated plain ones).
OFF = 4.5
# Evidence, nats, from which a cause that leaves no statistic beyond OFF spares the trials of dear
# kinds of other families: e^30 is more than another kind would gain by chance.
CLEAR = 30.0
# Evidence that a fit to some thousand samples may lack against a fit to all, nats: measured on
# the generator of test/hidden.
ROUGH = 20.0
# Time of the filters after which the search tries no more dear kinds, s.
MOST_COST = 10.0
# The same for the others, which take a tenth of a second or so: white noise beside many lines.
LAST_COST = 1.5 * MOST_COST
# Turns: measured inputs, laws where there are clear outliers, the rest.
TIERS = 3
# Kurtosis or tails, as a score, from which outliers are clear: an excess kurtosis of 1.1 in
# 12 000 samples (25 sqrt(24 / n)), which no wandering intensity of a usual size leaves.
OUTLIERS = 25.0
# Correlation of small neighbours, as a score, below which white noise is certain.
WHITE = -8.0

# Evidence from which a cause is accepted, nats: likelihood ratio e^6 = 403, which for 22 kinds
# tried leaves 5 % false alarms at most.
ACCEPT = 6.0
# The same for a mean that answers to a measured input, which every flight has: e^3 = 20, 5 % for
# one kind.
ACCEPT_MEAN = 3.0
# Share of the largest evidence that another term needs of a kind that is there: less mends its
# form, which is right to some per cent of the effect, and so to the square of it: (7 %)^2.  In
# simulated loads of ten shapes (test/hidden) further terms brought 0.8 % at most where the load
# model has the shape (sags, poles); 0.5 to 5 % where it has not (inductive, asymmetric).
AGAIN_SHARE = 0.005
# The same for one intensity over throttle beside another.  In 16 simulated recordings of four
# shapes the other curve brought 0.7 % at most; but the curves of the flights in doc/discovery.md
# leave a tenth of what the first explains, and this was chosen on them.
FORM = 0.1
# Share of its evidence that a latent law must keep beside a free law of throttle: what throttle
# explains the larger part of, in whatever form, is throttle's.
OWN = 0.5
# The recording cannot separate causes within this of the best from it, nats: odds below 20.
TIE = 3.0
# Evidence from which a measured cause stays after others were accepted, nats: its price (BIC) is
# already subtracted, and its input was measured.
NEEDED = 0.0
# A gain beyond this many standard errors exceeds the scatter of the segments of the recording: by
# chance one in 30 000 does.
STEADY = 4.0
# Share of segments with a gain from which it holds throughout: by chance 18 or more of 24 gain
# once in 100 (binomial: 1.1 %).
MOSTLY = 0.75
# Standard errors by which the sum of the gains of all parts must exceed zero: see `is_shared`.
SHARED = 1.0
# Relaxation times in a recording from which the rate is one, and no trend: it is then known to
# sqrt(2/20) = 30 %.
RELAXES = 20.0
# Chance from which a cause is not named: it does not show beside the others.
CHANCE = 0.05
# Statistics of outliers and clusters, as scores, above which single samples dominate the
# likelihood, so that the evidence must hold in most segments.
RAGGED = 8.0
# Most causes accepted, and most latent ones among them: each round costs as much as all before;
# no recording of test/hidden, with two effects at most, needed more.
MOST, MOST_LATENT = 8, 3
# Lines that are joined to a tone at once: harmonics of a motor or PWM up to the 13th.
MOST_LINES = 12
# Score from which a statistic counts as misfit (by chance one of 8000 does), and the sum of
# their squares below which the search asks no further: four scores of 5.
MISFIT, LITTLE = 4.0, 100.0
# Share of the misfit that a latent cause must remove for the search to go on.
HELPS = 0.5

# A statistic beyond this fails: of 70, one by chance in 2300 recordings (3 of 8700 simulated).
FAILS = 4.8
# Shares that a statistic may keep of its own value and of the largest value, both before any cause
# was accepted: the form of a cause leaves as much of a large effect.
OWN_SHARE, WORST_SHARE = 0.07, 0.02
# Share of its largest sign that a latent cause may leave beside measured ones.  In 70 recordings
# by another hand (doc/discovery_limits.md) right ones that left more than FAILS left 13 % at most,
# one of them 35 %; wrong ones 30 to 97 %.
BESIDE_SHARE = 0.3


# Which kinds are tried.

def kinds_to_try(kinds: Iterable[Kind], model: Sequence[Kind], values: Statistics,
                 given: Collection[str], tier: int, throttle: bool,
                 shown: Collection[str] = ()) -> list[Kind]:
    """
    Return the kinds of a tier to try beside those of a model, the dear ones last.

    `shown` are the names of those that a test of their own shows (`poles_shown`).
    """
    found = []
    for kind in kinds:
        if kind.NAME in ('ou', *given) or kind.ROLE is Role.EXACT or not kind.SIGNS or (
                is_answer(kind)):
            # On answers of the mean to what is measured the regression decides.
            continue
        if tier_of(kind, values) != tier or (kind.NEEDS_THROTTLE and not throttle):
            continue
        if not kind.RECURS and any(other.NAME == kind.NAME for other in model):
            continue
        if any(imitate(kind, other) for other in model):
            continue
        if asks(kind, values) or kind.NAME in shown:
            found.append(kind)
    # The kind with the largest statistic may spare the others; of the dear ones, laws come last,
    # which take longest and can imitate a slow state.
    return sorted(found, key=lambda kind: (
        kind.DEAR, kind.DEAR and kind.ROLE is Role.LAW, -asks(kind, values)))


def may_be_a_trend(kind: Kind) -> bool:
    """Return whether a latent cause is so slow that it can stand for a trend."""
    return kind.FAMILY == 'slow' and is_latent(kind)


def asks(kind: Kind, values: Statistics) -> float:
    """Return the largest statistic that asks for a kind; 0 where none does."""
    limit = ASK_DEAR if kind.DEAR else ASK
    return max((abs(value) for name, value in values.items() for sign in kind.SIGNS
                if abs(value) > limit and is_sign(sign, name, value)), default=0.0)


def poles_shown(pole: OtherPole) -> frozenset[str]:
    """Return the causes that the score test of another pole shows, as `analyze` reports them."""
    return frozenset(kind.NAME for kind, there in (
        (SecondRelaxation, pole.second), (ACCoupling, pole.coupled)) if there)


def any_off(values: Statistics) -> bool:
    """Return whether any statistic is clearly off."""
    return max(map(abs, values.values())) > OFF


def imitate(one: Kind, other: Kind) -> bool:
    """Return whether two kinds imitate each other."""
    return other.NAME in one.IMITATES or one.NAME in other.IMITATES


def tier_of(kind: Kind, values: Statistics) -> int:
    """Return when a kind has its turn: 0 measured inputs, 1 clear outliers, 2 the rest."""
    if kind.MEASURED or any(values.get(name, 0.0) > clear
                            for name, clear in kind.CLEAR_ABOVE.items()):
        return 0
    shape = max((abs(value) for name, value in values.items()
                 if name.startswith(('kurtosis', 'tails'))), default=0.0)
    # No Gaussian term produces outliers: where there are many, laws come first.
    outliers = shape > OUTLIERS
    if kind.ROLE is Role.NOISE:
        # Every sensor has white noise, which hides slow and weak effects; but bad samples
        # imitate it, except among small errors.
        return int(outliers and values.get('small errors lag 1', 0.0) > WHITE)
    return 1 if kind.ROLE is Role.LAW and outliers else 2


def settled(tried: Kind, left: Statistics | None, kind: Kind,
            shown: Collection[str] = ()) -> bool:
    """
    Return whether a trial spares that of a dear kind of another family.

    `left` are the statistics that the trial leaves, None where its evidence is not clear; `shown`
    as `kinds_to_try` takes it, of the model with the trial.
    """
    return (kind.DEAR and left is not None and not asks(kind, left)
            and kind.NAME not in shown and not any_off(left)
            and tried.FAMILY != kind.FAMILY and not imitate(kind, tried))


def comes_first(tried: Kind, evidence: float, kind: Kind, values: Statistics) -> bool:
    """
    Return whether a clear line is accepted before a dear kind of another family is tried.

    Where nothing is as far off as the line; the other kind has its turn beside it.
    """
    largest = max(map(abs, values.values()), default=0.0)
    return (kind.DEAR and tried.FAMILY == 'line' != kind.FAMILY and evidence > CLEAR
            and asks(tried, values) >= largest and not imitate(kind, tried))


def affordable(kind: Kind, cost: float) -> bool:
    """Return whether the search may still try a kind after fits of this cost (s)."""
    return cost <= (MOST_COST if kind.DEAR else LAST_COST)


# Which trial is accepted, and what comes with it.

def least_evidence(kind: Kind, largest: float, again: bool = False) -> float:
    """
    Return the evidence above which an answer of the mean is accepted (largest: of any; nats).

    again: whether there is one of this kind already, whose form it may only mend.
    """
    if kind.LEAST_SHARE:
        return max(ACCEPT, kind.LEAST_SHARE * largest)
    least = ACCEPT_MEAN if is_answer(kind) else ACCEPT
    return max(least, AGAIN_SHARE * largest) if again and is_answer(kind) else least


def is_answer(kind: Kind) -> bool:
    """Return whether a cause is an answer of the mean to what is measured."""
    return kind.MEASURED and kind.ROLE is Role.MEAN


def acceptable(kind: Kind, evidence: float, ragged: bool, throughout: bool) -> bool:
    """Return whether a trial may be accepted (evidence in nats)."""
    # A few outliers that coincide with one throttle by chance imitate an answer to throttle.
    return evidence > ACCEPT and (throughout or not (kind.MEASURED and ragged))


def best_of(trials: Sequence[tuple[str, float]]) -> str:
    """
    Return which cause of a round is accepted (name and evidence, nats, the best first).

    A trend that does as well as a latent slow cause comes first: time is measured.
    """
    best, top = trials[0]
    if may_be_a_trend(catalogue()[best]) and any(
            name == Drift.NAME and value > top - TIE for name, value in trials):
        return Drift.NAME
    return best


def is_throttles(alone: float, beside: float) -> bool:
    """Return whether throttle explains what a latent law does (alone, beside it: in nats)."""
    return beside < max(ACCEPT, OWN * alone)


def is_ragged(values: Statistics) -> bool:
    """Return whether single samples dominate the likelihood: scores are far from normal."""
    return any(name.startswith(('kurtosis', 'tails', 'clustering')) and value > RAGGED
               for name, value in values.items())


def is_throughout(mean: float, error: float, gains: Sequence[float]) -> bool:
    """
    Return whether a gain exceeds the scatter of the segments, or holds in most of them.

    mean, error: of the gain per sample, nats; gains: of each segment, nats.
    """
    return not mean <= STEADY * error or (
        sum(gain > 0.0 for gain in gains) >= MOSTLY * len(gains))


def is_shared(gains: npt.ArrayLike) -> bool:
    """
    Return whether more than one part of a recording gains (gains of each part, nats).

    Of k parts of which one alone gains, the standard error of the sum is that gain itself; of an
    effect that gains g nats throughout, it is sqrt(2 g).
    """
    parts = np.asarray(gains, dtype=np.float64)
    error = math.sqrt(parts.size) * float(parts.std(ddof=1))
    # A hair more: one part alone is on the edge.
    return bool(float(parts.sum()) > SHARED * error * (1.0 + 1e-9))


def rivals_of(best: str, evidence: Sequence[tuple[str, float]]) -> list[str]:
    """Return the causes of a round that do as well as the best one (evidence in nats)."""
    top = next(value for name, value in evidence if name == best)
    return [name for name, value in evidence if name != best and value > top - TIE]


def is_plainer(one: Kind, other: Kind) -> bool:
    """Return whether a cause is named before another that does as well: less was searched."""
    return one.SEARCH < other.SEARCH and one.FAMILY == other.FAMILY


def only_to_changes(answers: Iterable[Kind]) -> bool:
    """
    Return whether a mean answers to throttle by transients alone.

    What was behind a coupling does: no steady current is seen there.
    """
    names = {kind.NAME for kind in answers}
    return LoadTransient.NAME in names and LoadSag.NAME not in names


def relaxes(rate: float, duration: float) -> bool:
    """Return whether a recording shows a rate (1/s; duration in s), and no trend."""
    return rate * duration >= RELAXES


def helped(before: Statistics, after: Statistics, kind: Kind | None = None) -> bool:
    """Return whether the misfit has shrunk: of all statistics, or of those that ask for a kind."""
    asking = {name for name, value in before.items()
              if kind is None or any(is_sign(sign, name, value) for sign in kind.SIGNS)}

    def misfit(values: Statistics) -> float:
        return sum(value**2 for name, value in values.items()
                   if name in asking and abs(value) > MISFIT)

    left = misfit(after)
    return left < LITTLE or left < (1.0 - HELPS) * misfit(before)


def earns(gain: float, error: float, chance: float) -> bool:
    """
    Return whether a cause earns its place on blocks that were kept back (gain, error in nats).

    A gain that is not known is none to judge by; its chance is that of the fit alone.
    """
    return chance <= CHANCE and not gain < -error


# Standard errors from which a line is there, whatever else is left.
SURE = 25.0


# Which of those accepted stay.

def in_doubt(kind: Kind, last: Kind) -> bool:
    """Return whether a cause is tested again after another one was accepted."""
    # Another law of the noise casts no doubt on an answer to an input, unless the intensity
    # wanders: then it may follow throttle by chance.
    return not (last.ROLE is Role.LAW and kind.MEASURED and kind.FAMILY != last.FAMILY)


def needed_evidence(kind: Kind) -> float:
    """Return the evidence that a cause must bring to stay, nats."""
    # A measured cause stays unless it gains less than it costs.
    return NEEDED if kind.MEASURED else TIE


def failing(before: Statistics, after: Statistics) -> list[str]:
    """Return the statistics that the causes should have brought into their band and did not."""
    worst = max((abs(value) for value in before.values()), default=0.0)
    return [name for name, value in after.items()
            if abs(value) > max(FAILS, OWN_SHARE * abs(before.get(name, 0.0)),
                                WORST_SHARE * worst)]


def is_latent(kind: Kind) -> bool:
    """Return whether a cause is inferred only: neither from a measured input nor from time."""
    return not (kind.NEEDS_THROTTLE or kind.MEASURED)


def withdrawn(before: Statistics, after: Statistics, accepted: Sequence[Kind],
              asked: Mapping[str, Statistics] = MappingProxyType({})) -> list[int]:
    """
    Return which of the accepted causes claim what they do not explain.

    Beside measured causes, whose form is never complete on a real flight, something always fails:
    there a latent cause answers for its own signs, as the measured ones left them (`before`), or
    as they were when it was accepted (`asked`, by name), for a larger effect may have hidden
    them.  Alone, latent causes answer for everything: the effect may not be in the catalogue.
    """
    beside = not all(map(is_latent, accepted))
    left = failing(before, after)

    def largest(kind: Kind) -> float:
        return max((abs(value) for values in (before, asked.get(kind.NAME, {}))
                    for name, value in values.items()
                    if any(is_sign(sign, name, value) for sign in kind.SIGNS)), default=0.0)

    def fails(kind: Kind) -> bool:
        most = largest(kind)
        if beside:
            own = {name for name, value in before.items()
                   if any(is_sign(sign, name, value) for sign in kind.SIGNS)}
            share = max(kind.MAY_LEAVE, BESIDE_SHARE)
            return most < OFF or any(
                abs(after.get(name, 0.0)) > max(FAILS, share * most) for name in own)
        if not kind.MAY_LEAVE:
            return bool(left)
        if kind.REFUTED_BY and any(name.startswith(kind.REFUTED_BY) for name in left):
            return True
        return any(is_sign(sign, name, after[name]) and abs(after[name]) > kind.MAY_LEAVE * most
                   for name in left for sign in kind.SIGNS)

    return [k for k, kind in enumerate(accepted) if is_latent(kind) and fails(kind)]


def searched_again(loaded: bool, cost: float) -> bool:
    """
    Return whether the search goes on once without what was withdrawn (cost of fits so far, s).

    Beside a load what stays is put back alone: there something fails whatever is named.
    """
    return not loaded and cost <= MOST_COST
