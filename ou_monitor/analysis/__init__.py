"""What `analyze` finds beyond the fit of each level: tests, lines, transients, curves."""
