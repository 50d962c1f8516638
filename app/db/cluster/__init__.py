"""The private PostgreSQL cluster, and the programs of PostgreSQL."""
