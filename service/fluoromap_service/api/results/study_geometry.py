"""What triangulation says about a whole study, beside its points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import BaseModel, Field

from fluoromap.contracts import Array, LocatedSite, Triangulation
from fluoromap_service.api.results.origins import Origin, Position


class CalibrationOut(BaseModel):
    """What the electrodes of the study say about the gantry: view b's camera against its header."""

    applied: bool = Field(description="Whether the positions contain the correction.")
    rotation_deg: Position = Field(description="Rotation vector about the isocentre.")
    offset_mm: Position
    epipolar_before_px: float = Field(description="RMS distance between the two views' rays, in pixels.")
    epipolar_after_px: float


class ErrorBudgetOut(BaseModel):
    """What each source of error contributes to an electrode's position: RMS over the study, 3D, from the isocentre."""

    pixels_mm: float
    angles_mm: float
    source_distances_mm: float
    phase_mismatch_mm: float
    breathing_mm: float


class AlternativeOut(BaseModel):
    """Where an electrode would be if its site's catheters were paired the other way across the views."""

    site: str
    catheter: str
    electrode: int = Field(description="1 is the tip.")
    x_mm: float
    y_mm: float
    z_mm: float
    probability: float


class StudyGeometry(BaseModel):
    """The study's part of the answer of ``points``."""

    calibration: CalibrationOut | None = Field(description="Null where the triangulator makes none.")
    error_budget: ErrorBudgetOut | None = Field(description="Null where the triangulator makes none.")
    notes: list[str] = Field(description="Sentences for the report.")
    alternatives: list[AlternativeOut] = Field(description="In the same frame as the points.")


def study_geometry(triangulation: Triangulation, reference: str, origin: Origin) -> StudyGeometry:
    """What to tell of a triangulation; ``reference`` is the name of the reference catheter."""
    calibration, budget = triangulation.calibration, triangulation.budget
    return StudyGeometry(
        calibration=None if calibration is None else CalibrationOut(
            applied=calibration.applied,
            rotation_deg=_three(calibration.rotation_deg),
            offset_mm=_three(calibration.offset_mm),
            epipolar_before_px=calibration.epipolar_before_px,
            epipolar_after_px=calibration.epipolar_after_px,
        ),
        error_budget=None if budget is None else ErrorBudgetOut(
            pixels_mm=budget.pixels_mm,
            angles_mm=budget.angles_mm,
            source_distances_mm=budget.source_distances_mm,
            phase_mismatch_mm=budget.phase_mismatch_mm,
            breathing_mm=budget.breathing_mm,
        ),
        notes=list(triangulation.notes),
        alternatives=[one for site in triangulation.sites for one in _alternatives(site, reference, origin)],
    )  # fmt: skip


def _alternatives(site: LocatedSite, reference: str, origin: Origin) -> Iterator[AlternativeOut]:
    zero = np.zeros(3) if origin is Origin.ISOCENTRE else _reference_mm(site, reference)
    if zero is None:
        return
    for point in site.points:
        if point.alternative_mm is not None:
            x, y, z = _three(point.alternative_mm - zero)
            yield AlternativeOut(
                site=site.site, catheter=point.catheter, electrode=point.electrode, x_mm=x, y_mm=y, z_mm=z,
                probability=point.alternative_probability,
            )  # fmt: skip


def _reference_mm(site: LocatedSite, reference: str) -> Array | None:
    """The reference catheter's mean under the alternative pairing, which moves it where it is concerned itself."""
    places = [
        point.position_mm if point.alternative_mm is None else point.alternative_mm
        for point in site.points
        if point.catheter == reference
    ]
    return np.mean(places, axis=0) if places else None


def _three(vector: Array) -> Position:
    x, y, z = vector.tolist()
    return (x, y, z)
