"""Deliveries of results: the targets of the configuration, and the outbox in the database."""
