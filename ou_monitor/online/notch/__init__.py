"""Notches that follow the motors, and whether they help."""
