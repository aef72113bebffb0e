"""The service: the doors, the store, and the command line."""
