"""Requests for points, blocks and scenes, and their replies."""
