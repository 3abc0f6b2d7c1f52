"""Read CSV and autopilot logs as series of voltage, throttle, current; one module per format."""
