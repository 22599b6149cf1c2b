"""Spectra: curves over the wavelength, what they are read from, quadratures over them, and the colours they make."""
