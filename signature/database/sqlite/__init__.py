"""One SQLite file as the database."""
