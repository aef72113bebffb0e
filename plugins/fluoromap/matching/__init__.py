"""Catheter names across frames, runs and sites; cardiac phase; pairs across views."""

from fluoromap.matching.study import SiteRuns, match_study

__all__ = ["SiteRuns", "match_study"]
