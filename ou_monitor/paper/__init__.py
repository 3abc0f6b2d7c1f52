"""The paper's theory, its numbers recomputed, and the power network that `design` uses."""
