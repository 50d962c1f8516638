"""The adjustment of many images: a block with its tie points and its control."""
