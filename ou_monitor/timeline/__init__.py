"""Samples of any source -> samples in order, on one time line; for the node and offline."""
