#!/usr/bin/env python3
"""
Write the library of bags: `scripts/make_bags.py [FOLDER]` (default: bags/).

Each is a rosbag2 directory with a `truth.yaml`, the parameters of its simulation, against which an
estimate can be checked. The same seed gives the same messages. Parameters are from the paper's
Tables 1 and 2 unless stated otherwise.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
import shutil
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ou_monitor.model.ou import simulate  # noqa: E402, I100, I202
from ou_monitor.recordings.write import TYPES, write_recording  # noqa: E402
from ou_monitor.records import FloatArray, Recording  # noqa: E402
from ou_monitor.simulation import (  # noqa: E402
    ALPHA, FLIGHT, FLIGHT_NOISE, FLIGHT_SAG, PROFILES, SIGMA, TRANSIENT_SAG, U0)

# 2024-01-01T00:00:00Z: a fixed start, so that a bag does not depend on the day.
START_NS = 1_704_067_200 * 1_000_000_000


@dataclass(frozen=True)
class Bag:
    """One bag to be written: its samples and their true parameters."""

    name: str
    description: str
    type: str  # noqa: A003
    rate: float
    seed: int
    recording: Recording
    truth: dict[str, Any] = field(default_factory=dict)


def grid(duration: float, rate: float) -> FloatArray:
    """Return stamps from 0 at a steady rate, s."""
    return np.arange(round(duration * rate)) / rate


def steady(name: str, throttle: float, duration: float, rate: float, kind: str,
           seed: int) -> Bag:
    """Return OU noise at a constant throttle."""
    t = grid(duration, rate)
    sigma = SIGMA[throttle]
    u = simulate(t, ALPHA, sigma, np.random.default_rng(seed), u0=U0)
    return Bag(
        name, f'OU noise at a constant throttle of {throttle:.0%}', kind, rate, seed,
        Recording(t, u, np.full(t.shape, throttle), name),
        {'alpha': ALPHA, 'sigma': sigma, 'var_inf': sigma**2 / (2.0 * ALPHA), 'u0': U0,
         'noise_std': 0.0, 'throttle': throttle})


def transient(duration: float = 10.0, rate: float = 1000.0, seed: int = 20) -> Bag:
    """Return the step 0 -> 20 -> 0 %: the rail relaxes at rate alpha after both changes."""
    t = grid(duration, rate)
    on, off = 3.0, 6.0
    throttle = np.where((t >= on) & (t < off), 0.20, 0.0)
    down = -np.expm1(-ALPHA * np.clip(t - on, 0.0, off - on))
    deviation = np.where(t < off, down, np.exp(-ALPHA * np.maximum(t - off, 0.0)))
    level = U0 - TRANSIENT_SAG * deviation
    sigma = SIGMA[0.05]
    u = simulate(t, ALPHA, sigma, np.random.default_rng(seed), u0=level)
    return Bag(
        'transient', 'throttle 0 -> 20 -> 0 %, the sag relaxing with alpha as in Figure 5',
        'battery_state', rate, seed, Recording(t, u, throttle, 'transient'),
        {'alpha': ALPHA, 'sigma': sigma, 'var_inf': sigma**2 / (2.0 * ALPHA), 'u0': U0,
         'noise_std': 0.0, 'sag': TRANSIENT_SAG, 'throttle_on_s': on, 'throttle_off_s': off,
         'throttle': 0.20})


def flight_sigma(throttle: npt.ArrayLike) -> FloatArray:
    """Return sigma, V/sqrt(s): linear between the paper's loads, constant above 40 %."""
    return np.interp(throttle, list(SIGMA), list(SIGMA.values()))


def flight(duration: float = 40.0, rate: float = 1000.0, seed: int = 40) -> Bag:
    """Return a flight: sag proportional to throttle, sigma depending on it, sensor noise."""
    t = grid(duration, rate)
    throttle = PROFILES['flight'][0](t)
    # Rounded as in the bag (float32), so that the truth is made from the same values.
    throttle = throttle.astype(np.float32).astype(np.float64)
    rng = np.random.default_rng(seed)
    u = simulate(t, ALPHA, flight_sigma(throttle), rng, u0=U0 - FLIGHT_SAG * throttle)
    u += FLIGHT_NOISE * rng.standard_normal(t.size)
    return Bag(
        'flight', 'a flight with arming, take-off, hover, climbs, descents and landing',
        'battery_state', rate, seed, Recording(t, u, throttle, 'flight'),
        {'alpha': ALPHA, 'u0': U0, 'noise_std': FLIGHT_NOISE, 'sag': FLIGHT_SAG,
         'sigma_by_throttle': [[p, s] for p, s in SIGMA.items()],
         'throttle_profile': [list(point) for point in FLIGHT],
         'hover_throttle': 0.40, 'hover_s': [6.4, 12.0],
         'hover_sigma': SIGMA[0.40], 'hover_var_inf': SIGMA[0.40]**2 / (2.0 * ALPHA),
         'hover_u0': U0 - FLIGHT_SAG * 0.40})


def library() -> list[Bag]:
    """Return every bag."""
    return [
        steady('idle', 0.0, 10.0, 10000.0, 'adc_block', 1),
        steady('load_05', 0.05, 20.0, 1000.0, 'float64', 5),
        steady('load_10', 0.10, 20.0, 1000.0, 'float32', 10),
        steady('load_40', 0.40, 20.0, 1000.0, 'battery_state', 400),
        transient(),
        flight(),
    ]


def truth_of(bag: Bag) -> dict[str, Any]:
    """Return the content of truth.yaml."""
    return {
        'name': bag.name,
        'description': bag.description,
        'made_by': 'scripts/make_bags.py',
        'model': 'dU = -alpha (U - u0) dt + sigma dW, exact discretisation',
        'seed': bag.seed,
        'start_ns': START_NS,
        'rate': bag.rate,
        'n': bag.recording.n,
        'duration': bag.recording.n / bag.rate,
        'block': 100 if bag.type == 'adc_block' else None,
        'msg_config': {'float32': 'std_float32', 'float64': 'std_float64'}.get(
            bag.type, bag.type),
        'topics': {'/voltage': TYPES[bag.type], '/throttle': 'std_msgs/msg/Float32'},
        'units': {
            'alpha': '1/s', 'sigma': 'V/sqrt(s)', 'var_inf': 'V^2', 'u0': 'V', 'noise_std': 'V',
            'sag': 'V below u0 (transient: at 20 %; flight: at full throttle)',
            'throttle': '0..1', 'rate': 'Hz', 'duration': 's', 'start_ns': 'ns since 1970'},
        'parameters': bag.truth,
    }


def write(bag: Bag, folder: Path) -> Path:
    """Write one bag and its truth, in place of an older one; return its directory."""
    target = folder / bag.name
    if target.exists():
        # Only folders that this script made are ever removed.
        if not (target / 'truth.yaml').is_file():
            raise SystemExit(f'make_bags: {target} has no truth.yaml, so another program '
                             'made it: remove it first')
        shutil.rmtree(target)
    write_recording(bag.recording, target, type=bag.type, start_ns=START_NS, sample_rate=bag.rate)
    text = yaml.safe_dump(truth_of(bag), sort_keys=False, allow_unicode=True)
    (target / 'truth.yaml').write_text(text, encoding='utf-8')
    return target


def main() -> int:
    """Write the library; return the exit status."""
    parser = argparse.ArgumentParser(prog='make_bags', description=__doc__)
    parser.add_argument('folder', nargs='?', type=Path, default=ROOT / 'bags')
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for bag in library():
        target = write(bag, folder)
        size = sum(file.stat().st_size for file in target.iterdir())
        print(f'{target}: {bag.recording.n} samples, {size / 1e6:.2f} MB')
    return 0


if __name__ == '__main__':
    sys.exit(main())
