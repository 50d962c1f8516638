"""Surfaces: heights of the ground and the objects on it, from overlapping registered images."""
