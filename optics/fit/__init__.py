"""Fit: a model held against captures, its calibration, its comparison with the measurement, and null models."""
