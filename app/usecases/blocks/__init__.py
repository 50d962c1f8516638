"""Blocks in the store: ingestion, publication, export, quality and renewal."""
