"""Read and write recordings (MCAP bags, CSV, logs of autopilots) and model files."""
