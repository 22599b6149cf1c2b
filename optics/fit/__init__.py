"""Fit: a model of captures, its calibration, its comparison with the measurement, and null models."""
