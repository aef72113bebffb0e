"""The steps of a run, and its hypotheses: other scales, absent and unlisted catheters."""
