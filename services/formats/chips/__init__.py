"""Files of chips: the NumPy files of a block, and PNG, GeoTIFF and NPZ for other tools."""
