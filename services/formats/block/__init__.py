"""The Amers block: reading, writing and checking `block.json`, the two tables and the files."""
