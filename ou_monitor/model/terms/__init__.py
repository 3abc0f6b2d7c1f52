"""Terms of a supply model: the OU, and modules for the effects that may be added to it."""
