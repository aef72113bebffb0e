"""Celery tasks: claim a stage, keep its lease, run it, store what it returns."""
