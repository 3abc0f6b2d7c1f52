"""Read and write recordings: MCAP bags, CSV and logs of autopilots <-> `Recording`."""
