"""Control points made from images, from ortho-images or from points of other bases."""
