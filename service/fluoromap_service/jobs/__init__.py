"""Jobs: the table of stages, their life, their results, and the queue."""
