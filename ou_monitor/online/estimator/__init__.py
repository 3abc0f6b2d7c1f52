"""The sliding-window estimator: samples -> window -> estimate."""
