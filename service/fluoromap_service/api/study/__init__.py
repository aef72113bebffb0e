"""Routes on studies, their runs and their sites."""
