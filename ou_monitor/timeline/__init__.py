"""Samples of any source -> samples in order, on one time line; for node and bench alike."""
