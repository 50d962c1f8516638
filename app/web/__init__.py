"""The door for people: the map page."""
