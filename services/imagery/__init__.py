"""Images independent of their files: pixels, gaps, scenes with their models, catalogues."""
