"""Sensor models in files: RPC text, RPB, DIMAP, .geom, image tags, and corrections as JSON."""
