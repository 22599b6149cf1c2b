"""Diagnosis: which physical effect a calibrated model lacks, or why that cannot be said."""
