"""The store: PostgreSQL with PostGIS; one module per family of tables, tables with their queries."""
