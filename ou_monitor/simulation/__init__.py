"""Supplies, throttle profiles and recordings to simulate."""
