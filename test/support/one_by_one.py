"""Single messages into a `SampleStream`, with the source's time for those without a stamp."""

import numpy as np
from ou_monitor.stream.samples import SampleStream


def extracted(spec, message):
    """Return the values and the stamp, s, of a message; None: there is none."""
    values = np.atleast_1d(np.array(getattr(message, spec.field), dtype=float))
    values[~np.isfinite(values)] = np.nan
    if spec.nan == 'drop' and spec.sample_rate is None:
        values = values[np.isfinite(values)]
    stamp = None if spec.stamp_field is None else getattr(message, spec.stamp_field)
    if hasattr(stamp, 'sec'):
        stamp = stamp.sec + 1e-9 * stamp.nanosec
    return values, stamp or None


class OneByOne(SampleStream):
    """Takes message objects."""

    def open_voltage(self, spec):
        super().open_voltage(spec)
        self.voltage = spec

    def open_throttle(self, spec):
        super().open_throttle(spec)
        self.loads = spec

    def take_voltage(self, message, source_time):
        values, stamp = extracted(self.voltage, message)
        values = values if values.size or self._block else np.array([np.nan])
        end = source_time() if stamp is None else stamp
        return bool(self.take_voltages(np.array([end]), np.array([stamp is not None]),
                                       np.array([values.size]), values)[0])

    def take_throttle(self, message, source_time):
        values, stamp = extracted(self.loads, message)
        end = source_time() if stamp is None else stamp
        return self.add_throttle(end, stamp is not None, *(values.tolist() or [np.nan]))
