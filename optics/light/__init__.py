"""Light: from a scene to what the camera makes of it."""
