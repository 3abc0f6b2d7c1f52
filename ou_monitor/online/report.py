"""What the monitor reports of one instant, and its fields for diagnostics."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ou_monitor.online.load.supply_load import SupplyLoad
from ou_monitor.online.risk.flag import FlagState
from ou_monitor.online.trust import Doubt, StampOrder
from ou_monitor.records import Estimate, Level, OuFacts

# Throttles of `risk_curve`.
RISK_CURVE = tuple(k / 10.0 for k in range(11))


@dataclass(frozen=True)
class MonitorReport:
    """What is known at one instant."""

    estimate: Estimate  # Newest estimate; its alpha, sigma and var_inf are those of `ou`
    risk: float  # Probability of a brown-out within the horizon; NaN when not known
    # Highest throttle, 0..1, that keeps the risk under `brownout.budget_limit`; NaN when not
    # known.
    budget: float
    budget_reason: str  # What ends the budget, or why it is not known
    # Terms of the model file that move the supply and that the risk does not know of.
    left_out: tuple[str, ...]
    flag: FlagState  # The brown-out flag, and why
    level: Level  # Level for the diagnostics
    summary: str  # One line for the pilot
    age: float  # Age of the newest voltage, s; inf when none ever came
    # Age from which the input is stale, s: `stale_after`, less for a fast source, more for a slow
    # one.
    patience: float
    stamps: StampOrder  # What the stamps are good for
    doubt: Doubt  # Why the input is not trusted
    fresh: bool  # Whether the numbers rest on samples that are trusted and not too old
    # Samples that only the floor has judged, because there were more than could be estimated from.
    thinned: int
    restarts: int  # Times the estimator was started anew because of an error
    fault: str  # The last such error, in one line; empty when there was none
    # Level, sag and noise under load, as far as they are known; needs no relaxation.
    load: SupplyLoad = SupplyLoad()
    # Leg on which the risk stands: ``first_passage``, ``load``, ``excursions`` or ``none``.
    risk_basis: str = 'none'
    # What makes most of the risk: noise, load now, or throttle to come; empty: not known.
    risk_cause: str = ''
    # Risk if throttle goes to each of `RISK_CURVE` and stays for the horizon; empty or NaN: not
    # known.
    risk_curve: tuple[float, ...] = ()
    ou: OuFacts = OuFacts('no_data')  # Relaxation, or its bounds, and the window that it is of
    ou_age: float = 0.0  # How long before the newest sample that window ended, s

    @property
    def brownout(self) -> bool | None:
        """Return the flag; None when not known."""
        return self.flag.brownout

    @property
    def fields(self) -> dict[str, str]:
        """
        Return every field as text, for diagnostics; numbers round-trip.

        SI units; intervals are two numbers with a blank between them; `alpha_se`, `sigma_se` and
        `var_inf_se` are of the logarithm, `u0_se` in V.
        """
        e = self.estimate
        values: dict[str, object] = {
            name: getattr(e, name) for name in (
                't', 'alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'var_inf_se', 'tau',
                'u0', 'u0_se', 'noise_std', 'voltage', 'throttle', 'n', 'duration', 'rate')}
        for field in fields(self.ou):
            found = getattr(self.ou, field.name)
            if isinstance(found, tuple):
                values[field.name] = ' '.join(repr(float(end)) for end in found)
            elif field.name not in values:
                values['ou_status' if field.name == 'status' else field.name] = found
        values['ou_age'] = self.ou_age
        values |= self.load.fields(e.throttle)
        values['brownout_risk'] = self.risk
        values['risk_basis'] = self.risk_basis
        values['risk_cause'] = self.risk_cause
        values['risk_curve'] = ' '.join(
            f'{u:.1f}:{p:.3g}' for u, p in zip(RISK_CURVE, self.risk_curve))
        values['brownout'] = 'unknown' if self.brownout is None else str(self.brownout).lower()
        values['brownout_level'] = self.flag.level.name
        values['brownout_level_age'] = self.flag.age
        values['brownout_reason'] = self.flag.reason
        values['floor_dips'] = self.flag.dips
        values['throttle_budget'] = self.budget
        values['model_left_out'] = ','.join(self.left_out)
        values['throttle_budget_reason'] = self.budget_reason
        values['age'] = self.age
        values['patience'] = self.patience
        values['stamps'] = self.stamps.name
        values['doubt'] = self.doubt.value
        values['samples_thinned'] = self.thinned
        values['restarts'] = self.restarts
        values['fault'] = self.fault
        values['status'] = e.status.name
        values['status_text'] = e.status.value
        values['flags'] = ','.join(flag.name for flag in e.flags)
        for name in ('pushed', 'used', 'non_finite', 'late', 'held', 'resets'):
            values[name] = getattr(e.counters, name)
        # NumPy's floats write their type's name beside the number.
        return {name: repr(float(v)) if isinstance(v, float) else str(v)
                for name, v in values.items()}
