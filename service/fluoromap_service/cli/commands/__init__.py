"""The commands, one module each: the command ``X`` is in ``X.py``."""
