"""Accuracy of a simulated study: the located mapping tips against the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class SiteAccuracy:
    """Error of one site's mapping tip, relative to the reference catheter; None when the site has no position."""

    site: str
    error_mm: float | None
    grade: str
    reasons: tuple[str, ...]
    lat_ms: float | None


def accuracy(points: list[dict[str, Any]], truth: dict[str, Any], catheter: str = "mapping") -> list[SiteAccuracy]:
    """Return the distance of each site's tip from its true position at diastole.

    Parameters
    ----------
    points : list of dict
        Points of a job as ``/points`` answers them, millimetres along LPS axes, origin at the reference catheter.
    truth : dict
        Truth as :func:`fluoromap_service.dicom.simulation.truth_of` writes it.
    catheter : str
        Name of the catheter whose electrode 1 is measured.
    """
    tips = {point["site"]: point for point in points if point["catheter"] == catheter and point["electrode"] == 1}
    rows = []
    for site in truth["sites"]:
        tip = tips.get(site["site"])
        if tip is None:
            rows.append(SiteAccuracy(site["site"], None, "rejected", (), None))
            continue
        has_position = tip["x_mm"] is not None
        position_mm = [tip["x_mm"], tip["y_mm"], tip["z_mm"]]
        error_mm = math.dist(position_mm, site["relative_mm"][catheter][0]) if has_position else None
        rows.append(SiteAccuracy(site["site"], error_mm, tip["grade"], tuple(tip["reasons"]), tip["lat_ms"]))
    return rows


def rms_mm(rows: list[SiteAccuracy]) -> float | None:
    """Return the root mean square error of the located sites; None without any."""
    errors = [row.error_mm for row in rows if row.error_mm is not None]
    return math.sqrt(sum(error**2 for error in errors) / len(errors)) if errors else None
