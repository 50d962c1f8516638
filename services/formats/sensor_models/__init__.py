"""Sensor models in files: RPC text, RPB, DIMAP, image tags, and corrections as JSON."""
