"""Captures made by another path than the model that is fitted to them."""
