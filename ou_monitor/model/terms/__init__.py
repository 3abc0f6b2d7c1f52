"""What a supply is made of: the OU and one module for each effect that may be added to it."""
