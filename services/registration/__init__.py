"""The registration of one scene, on control points or on a reference image."""
