"""Throttle or current -> voltage under load: level, sag, noise."""
