"""A recording becomes the maps of a session."""
