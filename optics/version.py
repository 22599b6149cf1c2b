"""The version of this package; pyproject.toml states the same, which a test checks."""

__version__ = "0.1.0"
