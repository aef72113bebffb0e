"""The rows of the report's tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median
from typing import Any

import numpy as np

from fluoromap.contracts import CHI2_95_3D, Calibration, ChamberMap, ErrorBudget
from fluoromap.reasons import Reason
from fluoromap_service.api.results.points import Point
from fluoromap_service.api.results.tracks import Entry

Row = dict[str, Any]


def tips(points: Sequence[Point], mapping: str, chamber: ChamberMap | None) -> list[Row]:
    """Return a row for the mapping tip of every site.

    It includes the tip's place on the map.
    """
    on_map = {site.site: site for site in chamber.sites} if chamber else {}
    rows = []
    for point in points:
        if point.catheter != mapping or point.electrode != 1:
            continue
        mapped = on_map.get(point.site)
        reasons = [*point.reasons, *(mapped.reasons if mapped else ())]
        rows.append(
            {
                "site": point.site, "lat_ms": point.lat_ms, "x_mm": point.x_mm, "y_mm": point.y_mm, "z_mm": point.z_mm,
                "semi_axis_mm": _semi_axis_mm(point), "residual_a_px": point.residual_px.a,
                "residual_b_px": point.residual_px.b, "ray_angle_deg": point.ray_angle_deg,
                "distance_mm": mapped.distance_mm if mapped else None,
                "leave_one_out_error_ms": mapped.leave_one_out_error_ms if mapped else None,
                "grade": str(point.grade), "reasons": list(dict.fromkeys(reasons)),
            }
        )  # fmt: skip
    return rows


def electrodes(points: Sequence[Point]) -> list[Row]:
    """Return a row for every electrode."""
    return [
        {
            "site": point.site, "catheter": point.catheter, "electrode": point.electrode, "x_mm": point.x_mm,
            "y_mm": point.y_mm, "z_mm": point.z_mm, "sd_mm": _sd_mm(point),
            "frame_a": point.views.a.frame if point.views.a else None,
            "frame_b": point.views.b.frame if point.views.b else None,
            "grade": str(point.grade), "reasons": point.reasons,
        }
        for point in points
    ]  # fmt: skip


def tracks(entries: Iterable[Entry]) -> list[Row]:
    """Return a row for every view.

    It is the track of its mapping tip, or the reasons why it has none.

    Parameters
    ----------
    entries : iterable of Entry
        From ``read_entries`` for the tip of the mapping catheter.
    """
    rows, rejected = [], []
    for name, entry in entries:
        if name == "rejected":
            rejected.append(
                {
                    "site": entry["site"], "view": entry["view"], "solver": "no track", "located": 0, "frames": 0,
                    "reasons": [Reason(reason) for reason in entry["reasons"]], "along_mm": None, "lateral_mm": None,
                }
            )  # fmt: skip
            continue
        located = [sample for sample in entry["samples"] if sample["x_mm"] is not None]
        reasons = dict.fromkeys(Reason(reason) for sample in entry["samples"] for reason in sample["reasons"])
        rows.append(
            {
                "site": entry["site"], "view": entry["view"], "solver": entry["solver"], "located": len(located),
                "frames": len(entry["samples"]), "reasons": list(reasons),
                "along_mm": median(sample["along_ray_sd_mm"] for sample in located) if located else None,
                "lateral_mm": median(sample["lateral_sd_mm"] for sample in located) if located else None,
            }
        )  # fmt: skip
    return rows + rejected


def glossary(rows: Sequence[Row]) -> list[Reason]:
    """Return every reason that occurs, once."""
    return sorted({reason for row in rows for reason in row["reasons"]})


def budget_rows(budget: ErrorBudget | None) -> list[tuple[str, float]]:
    """Return name and size in mm of each source of error."""
    if budget is None:
        return []
    return [
        ("pixels: the place of the electrodes in the image", budget.pixels_mm),
        ("angles of the gantry", budget.angles_mm),
        ("distances of source and detector", budget.source_distances_mm),
        ("cardiac phase: the frames of the two runs show different moments of the beat", budget.phase_mismatch_mm),
        ("breathing between the two runs", budget.breathing_mm),
    ]


def calibration_line(calibration: Calibration | None) -> Row | None:
    """Return the figures of the gantry's self-calibration."""
    if calibration is None:
        return None
    return {
        "applied": calibration.applied,
        "turned_deg": float(np.linalg.norm(calibration.rotation_deg)),
        "shifted_mm": float(np.linalg.norm(calibration.offset_mm)),
        "before_px": calibration.epipolar_before_px,
        "after_px": calibration.epipolar_after_px,
    }


def _semi_axis_mm(point: Point) -> float | None:
    if point.covariance_mm2 is None:
        return None
    xx, xy, xz, yy, yz, zz = point.covariance_mm2
    return float(np.sqrt(CHI2_95_3D * np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[-1]))


def _sd_mm(point: Point) -> list[float | None]:
    if point.covariance_mm2 is None:
        return [None, None, None]
    xx, _, _, yy, _, zz = point.covariance_mm2
    return [xx**0.5, yy**0.5, zz**0.5]
