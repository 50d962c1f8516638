"""Scenes resampled onto a map through their sensor model and a terrain."""
