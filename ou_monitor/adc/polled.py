"""
A voltage that is asked for: hwmon (`inN_input`), or an IIO channel without a buffer (`_raw`).

Limits: a sample is as old as the driver's last conversion, which many drivers keep for
`update_interval`; asking more often gives the same number again.
"""

from __future__ import annotations

from pathlib import Path

from ou_monitor.adc import sysfs
from ou_monitor.errors import InputError

# Asked so often where the driver does not say how often it converts, Hz.
USUAL_RATE = 10.0


class PolledChannel:
    """
    One channel of a hwmon or IIO device.

    Parameters
    ----------
    folder : Path
        Its folder in sysfs.
    channel : str
        'in1' of a hwmon, 'in_voltage0' of an IIO device; empty: the only one.

    Attributes
    ----------
    channel : str
        The channel.
    rate : float
        How often the driver converts, Hz, or 10 where it does not say.

    """

    def __init__(self, folder: Path, channel: str = '') -> None:
        ends = {'_input': 'in[0-9]*_input', '_raw': 'in_voltage*_raw'}
        known = {path.name.removesuffix(end): path for end, pattern in ends.items()
                 for path in sorted(folder.glob(pattern))}
        if channel and channel not in known or not channel and len(known) != 1:
            asked = f"no channel '{channel}'" if channel else f'{len(known)} voltage channels'
            names = ', '.join(known) or 'none'
            raise InputError(f'{folder.name} has {asked}: give channel:= one of {names}')
        self.channel = channel or next(iter(known))
        self._path = known[self.channel]
        self._scale, self._offset = 1.0, 0.0
        if self._path.name.endswith('_raw'):
            self._scale = self._attribute(folder, 'scale', 1.0)
            self._offset = self._attribute(folder, 'offset', 0.0)
        interval = folder / 'update_interval'
        spacing = sysfs.number(interval) if interval.exists() else 0.0
        self.rate = 1e3 / spacing if spacing > 0.0 else USUAL_RATE
        self.read()

    def _attribute(self, folder: Path, what: str, default: float) -> float:
        for name in (f'{self.channel}_{what}', f'in_voltage_{what}'):
            if (folder / name).exists():
                return sysfs.number(folder / name)
        return default

    def read(self) -> float:
        """Return the voltage now, V (both kinds count in mV)."""
        return (sysfs.number(self._path) + self._offset) * self._scale * 1e-3
