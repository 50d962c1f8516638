"""Readers and writers of files. No other package of `services` opens files."""
