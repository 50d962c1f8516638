"""Backups of database and stored files, made, verified and restored."""
