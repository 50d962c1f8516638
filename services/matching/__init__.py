"""Positions of chips in images, and points that several images show."""
