"""Routes on jobs."""
