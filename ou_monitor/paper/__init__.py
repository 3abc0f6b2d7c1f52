"""The paper: its theory, its network, and every number of it recomputed."""
