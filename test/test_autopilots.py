"""The page on autopilots: its message descriptions load, and its MSP reader reads real frames."""

from pathlib import Path
import re

from ou_monitor.stream.config import load_msg_config
import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / 'doc' / 'autopilots.md').read_text(encoding='utf-8')
BLOCKS = re.findall(r'```yaml\n(description:.*?)```', PAGE, re.DOTALL)


@pytest.mark.parametrize('block', BLOCKS)
def test_a_description_loads(block, tmp_path):
    path = tmp_path / 'own.yaml'
    path.write_text(block, encoding='utf-8')
    found = load_msg_config(path)
    assert found.voltage.topic and found.throttle is not None and found.throttle.topic


class Port:
    """A serial port with what a flight controller sends."""

    def __init__(self, volts, amps, motors, broken=False):
        """Keep it: V, A, and 1000 to 2000."""
        self.analog = bytes((int(10 * volts), 0, 0, 0, 0)) + round(100 * amps).to_bytes(
            2, 'little', signed=True) + round(100 * volts).to_bytes(2, 'little')
        self.motors = b''.join(one.to_bytes(2, 'little') for one in motors)
        self.broken, self.rest = broken, b''

    def write(self, data):
        assert data[:3] == b'$M<' and data[3] ^ data[4] == data[5]
        payload = {110: self.analog, 104: self.motors}[data[4]]
        check = len(payload) ^ data[4]
        for byte in payload:
            check ^= byte
        self.rest = b'$M>' + bytes((len(payload), data[4])) + payload + bytes(
            ((check + self.broken) % 256,))

    def read(self, size):
        found, self.rest = self.rest[:size], self.rest[size:]
        return found

    def reset_input_buffer(self):
        self.rest = b''


def test_betaflight_msp_is_decoded():
    """Volts, amperes and the mean of the motors that are there; a broken answer is none."""
    code = re.search(r'```python\n(import struct.*?)```', PAGE, re.DOTALL)[1]
    space = {}
    exec(compile(code, 'autopilots.md', 'exec'), space)
    volts, amps, throttle = space['supply'](Port(15.87, 23.4, (1500, 1600, 1400, 1500, 0, 0)))
    assert (volts, amps, throttle) == pytest.approx((15.87, 23.4, 0.5))
    assert space['supply'](Port(15.87, -1.0, (1000,) * 4)) == pytest.approx((15.87, -1.0, 0.0))
    assert space['supply'](Port(15.87, 1.0, (1500,) * 4, broken=True)) is None
