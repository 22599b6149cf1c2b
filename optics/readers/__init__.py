"""Readers: what a robot computes from the images of a touch sensor that also sees, such as marker displacements,
proximity and contact."""
