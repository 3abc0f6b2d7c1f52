"""The paper's numbers and claims, recomputed: one row each, the verdict computed too."""
