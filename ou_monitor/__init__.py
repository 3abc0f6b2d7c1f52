"""Noise-aware state estimation for UAV supply rails."""
