"""The map page, the entry point for people."""
