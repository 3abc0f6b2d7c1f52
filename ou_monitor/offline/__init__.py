"""On the bench: a recording -> answers."""
