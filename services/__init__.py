"""Scientific computations on arrays, independent of web, database, settings and clock."""
