"""`compare`: what simulations of a recording get right and wrong; export to other simulators."""
