"""`analyze` (load levels, tests), `coupling`, and the facts all commands report."""
