"""The tables of the archive, in SQLite or another database."""
