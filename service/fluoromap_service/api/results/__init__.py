"""Routes on the results of jobs."""
