"""A PostgreSQL server as the database."""
