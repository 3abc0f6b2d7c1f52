"""Test a model against a recording: integrity of the samples, fit, innovations, statistics."""
