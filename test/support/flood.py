"""
A program that sends voltages at a rate, Hz, in a burst every ms, with a dip every 2 s.

    python flood.py RATE DIP [TOPIC [TYPE]]
"""

import sys
import time

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Float64

# Maximum samples sent at once to catch up.
MOST = 2000


def main(rate, dip, topic='/load/voltage', kind='Float64'):
    """Send until killed (rate in Hz, dip in s)."""
    rclpy.init()
    node = rclpy.create_node('flood')
    message, field = (
        (BatteryState, 'voltage') if kind == 'BatteryState' else (Float64, 'data'))
    output = node.create_publisher(message, topic, QoSProfile(
        depth=MOST, reliability=ReliabilityPolicy.BEST_EFFORT))
    while not output.get_subscription_count():
        time.sleep(0.01)
    start, sent = time.monotonic(), 0
    good = [message(**{field: 5.0 + 0.01 * (k * 7919 % 13 - 6)}) for k in range(13)]
    low = message(**{field: 3.0})
    while True:
        now = time.monotonic() - start
        due = int(now * rate)
        sent = max(sent, due - MOST)
        while sent < due:
            output.publish(low if 1.0 <= sent / rate % 2.0 < 1.0 + dip else good[sent % 13])
            sent += 1
        time.sleep(0.001)


if __name__ == '__main__':
    main(float(sys.argv[1]), float(sys.argv[2]), *sys.argv[3:])
