"""Captures: measurements on disk, their noise, and how other formats become captures."""
