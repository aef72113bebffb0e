"""Tracks: the chains of one catheter along a run, in one direction, with one name."""
