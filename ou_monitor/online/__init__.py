"""Onboard: samples -> window -> estimate -> risk and cutoff."""
