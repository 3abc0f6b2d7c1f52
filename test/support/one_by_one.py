"""Messages one by one into a `SampleStream`, with the source's time where one has no stamp."""

import numpy as np
from ou_monitor.stream.config import Extractor
from ou_monitor.stream.samples import SampleStream


class OneByOne(SampleStream):
    """Takes message objects."""

    def open_voltage(self, spec):
        """Set the field of the voltage."""
        super().open_voltage(spec)
        self.extract_voltage = Extractor(spec).extract

    def open_throttle(self, spec):
        """Set the field of the throttle."""
        super().open_throttle(spec)
        self.extract_throttle = Extractor(spec).extract

    def take_voltage(self, message, source_time):
        """Take one message of the voltage."""
        found = self.extract_voltage(message)
        values = found.values if found.values.size or self._block else np.array([np.nan])
        end = source_time() if found.stamp is None else found.stamp
        return bool(self.take_voltages(np.array([end]), np.array([found.stamp is not None]),
                                       np.array([values.size]), values)[0])

    def take_throttle(self, message, source_time):
        """Take one message of the throttle."""
        found = self.extract_throttle(message)
        end = source_time() if found.stamp is None else found.stamp
        return self.take_throttles(end, found.stamp is not None, found.values)
