"""Makers of captures: independent renderers that share no code path with the model that is fitted to them."""
