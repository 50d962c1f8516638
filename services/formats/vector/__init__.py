"""Vector files: feature tables as GeoParquet, GeoPackage, FlatGeobuf, and layers of residuals."""
