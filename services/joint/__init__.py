"""Scenes registered together in one adjustment."""
