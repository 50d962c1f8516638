"""Vectors digitised on a raw scene, brought onto the map, and map vectors brought into the scene."""
