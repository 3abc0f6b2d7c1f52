"""The paper: theory, every number recomputed; the power network, and `design` with it."""
