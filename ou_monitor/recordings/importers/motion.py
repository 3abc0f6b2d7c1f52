"""
What a log holds of the vehicle's motion: gyros with accelerometers, speeds of motors.

Limits first: axes are those of `base_link` (REP-103: x forwards, y left, z up) as the
autopilot defines its own; how its board is mounted is corrected as far as it did so itself.
Gyro and accelerometer share a message only where the log gives them one stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray

# Front, right, down -> front, left, up.
FRD_TO_FLU = np.array([1.0, -1.0, -1.0])
DEGREE = math.pi / 180.0
GRAVITY = 9.80665  # m/s^2, by which accelerometers are scaled
RPM = 2.0 * math.pi / 60.0


@dataclass(frozen=True, eq=False)
class Inertial:
    """
    A gyro, an accelerometer, or both.

    Attributes
    ----------
    name : str
        How the user names it.
    t : ndarray, shape (n,)
        Stamps, s from the start of the log.
    angular_velocity, acceleration : ndarray, shape (n, 3), or None
        rad/s and m/s^2 along the axes of `base_link`, the acceleration with
        what holds against gravity; None where the log has none.
    scale, words : str
        How the values were made; what it is.
    rank : int or None
        Taken when nothing of a smaller rank is there; None: only by name.

    """

    name: str
    t: FloatArray
    angular_velocity: FloatArray | None
    acceleration: FloatArray | None
    scale: str
    words: str
    rank: int | None = None


@dataclass(frozen=True, eq=False)
class MotorSpeeds:
    """
    Speeds of all motors at the same stamps.

    Attributes
    ----------
    names : tuple of str
        Of the m motors, as in the message: ``motor_0``.
    t : ndarray, shape (n,)
        Stamps, s from the start of the log.
    values : ndarray, shape (n, m)
        Of the rotor, rad/s.
    scale, words : str
        How the values were made, poles included; what they are.

    """

    names: tuple[str, ...]
    t: FloatArray
    values: FloatArray
    scale: str
    words: str
