"""Reports as diagnostic messages."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.time import Time


def diagnostic(name: str, level: int, summary: str, fields: Mapping[str, str],
               stamp: float, hardware_id: str = '') -> DiagnosticArray:
    """Return one status as a stamped message (stamp in s)."""
    message = DiagnosticArray()
    message.header.stamp = to_time(stamp)
    message.status = [DiagnosticStatus(
        level=bytes([level]), name=name, message=summary, hardware_id=hardware_id,
        values=[KeyValue(key=key, value=value) for key, value in fields.items()])]
    return message


def to_time(stamp: float) -> object:
    """Return builtin_interfaces/Time of a stamp in s; 0 when there is none."""
    # The comparison is false for NaN too.
    nanoseconds = round(stamp * 1e9) if 0.0 <= stamp < 2.0 ** 31 else 0
    return Time(nanoseconds=nanoseconds).to_msg()
