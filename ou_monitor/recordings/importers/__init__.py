"""Logs of autopilots, one module a format -> series of voltage, throttle and current."""
