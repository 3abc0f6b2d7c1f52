"""Read CSV and autopilot logs, one module per format -> series of voltage, throttle, current."""
