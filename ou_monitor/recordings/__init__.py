"""File formats <-> Recording."""
