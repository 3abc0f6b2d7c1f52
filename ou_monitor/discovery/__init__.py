"""`discover`: find what a simulation gets wrong, name causes, extend the model, score the gain."""
