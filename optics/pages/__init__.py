"""Pages: the report of a study and the live view."""
