"""Matching: catheter names across frames, runs and sites; cardiac phase; pairs across views."""

from fluoromap.matching.site_comparison import SiteRuns
from fluoromap.matching.study_matching import match_study

__all__ = ["VERSION", "SiteRuns", "match_study"]

VERSION = "8"
"""Version of the results: it changes whenever the same chains give another result; results are stored under it."""
