"""First passage of the supply to a level: laws, means, samples."""
