"""The HTTP entry point: one router per resource."""
