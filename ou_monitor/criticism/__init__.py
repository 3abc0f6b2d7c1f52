"""Fit a model to a recording and test it: integrity of the samples, innovations, statistics."""
