"""`analyze` (load levels, tests, transients), `coupling`, and the facts all commands report."""
