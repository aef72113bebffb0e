"""The steps of a run, from its frames to the chains of all frames and of diastole."""
