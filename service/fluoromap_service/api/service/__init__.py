"""Routes on the service itself."""
