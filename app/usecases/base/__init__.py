"""Bases of control points from open archives of ortho-images."""
