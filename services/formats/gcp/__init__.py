"""Ground control points marked in images, in the exchange formats of the field."""
