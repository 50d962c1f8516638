"""The science: arrays in, arrays out. It knows no web, database, settings or clock."""
