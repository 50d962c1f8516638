"""The adjustment of one scene: its affine correction, and displacements that this cannot follow."""
