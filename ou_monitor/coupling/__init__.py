"""How much of a signal is noise of the supply."""
