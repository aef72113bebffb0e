"""A site of the structured report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ReportSite:
    """A located site: tip position in mm (LPS, from the origin of the job), its largest SD, the activation time."""

    site: str
    position_mm: tuple[float, float, float]
    sd_mm: float
    lat_ms: float | None
