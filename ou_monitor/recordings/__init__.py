"""Read and write recordings (MCAP bags, CSV, autopilot logs) and model files."""
