"""Mueller calculus, and layers that change the polarization of light that passes."""
