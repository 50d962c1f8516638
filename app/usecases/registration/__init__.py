"""Registrations of one scene or of several, with their control and their outputs."""
