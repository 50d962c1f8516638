"""The HTTP door: one router per resource."""
