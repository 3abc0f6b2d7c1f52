"""Estimate -> brown-out risk, throttle budget and flag."""
