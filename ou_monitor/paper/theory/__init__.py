"""Switching, averaging and the diffusion limit, as in sections 3.1 to 3.3."""
