"""Digital elevation models and geoids, converted to heights above the WGS 84 ellipsoid."""
