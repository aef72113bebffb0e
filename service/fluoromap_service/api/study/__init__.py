"""Routes of studies, their runs and their sites."""
