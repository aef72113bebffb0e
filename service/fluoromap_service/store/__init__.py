"""The store: rows in SQL, bytes in content-addressed files."""
