"""Catheter names across frames, runs and sites; cardiac phase; pairs across views."""

from fluoromap.matching.study_matching import SiteRuns, match_study

__all__ = ["VERSION", "SiteRuns", "match_study"]

VERSION = "3"
"""Of the answers: raised whenever the same chains are matched otherwise; results are kept by it."""
