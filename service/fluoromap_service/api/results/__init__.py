"""Routes of the results of jobs."""
