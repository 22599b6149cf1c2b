"""Files on disk: images, TOML, and output that is whole or absent."""
