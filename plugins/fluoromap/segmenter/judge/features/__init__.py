"""What is measured of a chain or a track before it is judged."""
