"""Readers and writers of files: the only package of `services` that opens any."""
