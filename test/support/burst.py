"""
A program that sends bursts of 5 V messages, as commanded by lines on its input.

    python burst.py TOPIC    each line: NUMBER of messages, FIRST and LAST of those at 3 V
"""

import sys
import time

from builtin_interfaces.msg import Time
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState


def main(topic):
    """Send with stamps 1 ms apart; print a line when done."""
    rclpy.init()
    node = rclpy.create_node('burst')
    output = node.create_publisher(BatteryState, topic, QoSProfile(
        depth=10, reliability=ReliabilityPolicy.BEST_EFFORT))
    while not output.get_subscription_count():
        time.sleep(0.01)
    print('ready', flush=True)
    for line in sys.stdin:
        number, first, last = map(int, line.split())
        begin = time.time_ns() - number * 10**6
        for k in range(number):
            message = BatteryState(voltage=3.0 if first <= k < last else 5.0)
            stamp = begin + k * 10**6
            message.header.stamp = Time(sec=stamp // 10**9, nanosec=stamp % 10**9)
            output.publish(message)
        print('sent', flush=True)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main(sys.argv[1])
