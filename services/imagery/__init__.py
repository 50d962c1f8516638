"""Images without their files: pixels, gaps, scenes with their models, catalogues."""
