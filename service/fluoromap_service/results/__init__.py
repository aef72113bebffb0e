"""Stored results of jobs as values: what readers ask for, without HTTP."""
