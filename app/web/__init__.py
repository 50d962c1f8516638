"""The entry point for people: the map page."""
