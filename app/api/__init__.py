"""The HTTP entry point: one router for each resource."""
