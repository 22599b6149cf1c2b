"""What a robot computes from the images of a touch sensor that also sees: marker displacements, and how near a thing
is."""
