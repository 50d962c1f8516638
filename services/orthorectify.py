"""A scene laid on a map through its model and the terrain."""
