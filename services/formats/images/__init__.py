"""Image files: rasters, bands, masks, scenes with their models, and ortho-images."""
