"""Amers: an open base of 3D ground control points, and the registration of satellite scenes on them."""
