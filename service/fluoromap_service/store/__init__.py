"""Everything that is kept: rows in SQL, bytes in content-addressed files."""
