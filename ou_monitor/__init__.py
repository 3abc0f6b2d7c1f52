"""
Noise-aware state estimation for UAV supply rails.

Public names are loaded on first use (PEP 562): ``import ou_monitor`` is fast, and the
estimator never loads the readers of recordings.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ou_monitor.analysis.supply import supply_facts, SupplyFacts
    from ou_monitor.bench import (
        analyze, compare, coupling, design, discover, reproduce, simulate)
    from ou_monitor.errors import InputError
    from ou_monitor.online.estimator.estimator import SlidingEstimator
    from ou_monitor.online.filter.lowpass import AdaptiveLowPass
    from ou_monitor.online.monitor import SupplyMonitor
    from ou_monitor.online.notch import AdaptiveNotch
    from ou_monitor.online.risk.first_passage import brownout_probability
    from ou_monitor.online.settings import MonitorSettings
    from ou_monitor.recordings.importers.log import CsvColumns
    from ou_monitor.recordings.read import read_recording
    from ou_monitor.records import Estimate, Flag, Recording, Status
    from ou_monitor.report.result import Result

__version__ = '0.3.0'

_HOMES = {
    'AdaptiveLowPass': 'ou_monitor.online.filter.lowpass',
    'AdaptiveNotch': 'ou_monitor.online.notch',
    'CsvColumns': 'ou_monitor.recordings.importers.log',
    'Estimate': 'ou_monitor.records',
    'Flag': 'ou_monitor.records',
    'InputError': 'ou_monitor.errors',
    'MonitorSettings': 'ou_monitor.online.settings',
    'Recording': 'ou_monitor.records',
    'Result': 'ou_monitor.report.result',
    'SlidingEstimator': 'ou_monitor.online.estimator.estimator',
    'Status': 'ou_monitor.records',
    'SupplyFacts': 'ou_monitor.analysis.supply',
    'SupplyMonitor': 'ou_monitor.online.monitor',
    **dict.fromkeys(('analyze', 'compare', 'coupling', 'design', 'discover', 'reproduce',
                     'simulate'), 'ou_monitor.bench'),
    'brownout_probability': 'ou_monitor.online.risk.first_passage',
    'read_recording': 'ou_monitor.recordings.read',
    'supply_facts': 'ou_monitor.analysis.supply',
}

__all__ = [
    'AdaptiveLowPass', 'AdaptiveNotch', 'CsvColumns', 'Estimate', 'Flag', 'InputError',
    'MonitorSettings', 'Recording', 'Result', 'SlidingEstimator', 'Status', 'SupplyFacts',
    'SupplyMonitor', '__version__', 'analyze', 'brownout_probability', 'compare', 'coupling',
    'design', 'discover', 'read_recording', 'reproduce', 'simulate', 'supply_facts',
]


def __getattr__(name: str) -> object:
    """Load a public name from its module on first use."""
    home = _HOMES.get(name)
    if home is None:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value: object = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted(set(globals()) | set(__all__))
