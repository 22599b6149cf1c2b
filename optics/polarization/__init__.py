"""Polarization: Mueller calculus, and how thin layers change the light that passes them."""
