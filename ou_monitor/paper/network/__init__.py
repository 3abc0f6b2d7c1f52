"""A power network from its components: battery, capacitor, filter, regulator, ESCs."""
