"""A recording beside simulations of it: what they get right, and what wrong."""
