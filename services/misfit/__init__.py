"""The adjustment of one scene: an affine correction, and displacements that are not affine."""
