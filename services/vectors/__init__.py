"""Vectors digitised on a raw scene and moved to the map, and map vectors moved to the scene."""
