"""Sensor models: the relation between image and ground positions, and its correction."""
