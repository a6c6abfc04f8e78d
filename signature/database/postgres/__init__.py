"""A PostgreSQL server with pgvector as the database."""
