"""Logs of autopilots, one module per format -> series of voltage, throttle and current."""
