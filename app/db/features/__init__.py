"""Queries of points, blocks and scenes: filters, pages, counts and serialisation."""
