"""Notches that follow the motors, and whether they pay."""
