"""Surfaces: heights of the ground and of what stands on it, from overlapping registered images."""
