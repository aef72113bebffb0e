"""Hypotheses about a run: its scale and polarity, other scales, absent, added and unlisted catheters."""
