"""The part of the points' answer that concerns the whole study."""

from __future__ import annotations

from pydantic import BaseModel, Field

from fluoromap.contracts import Array, ElectrodePoint, Triangulation
from fluoromap_service.api.results.origins import Position
from fluoromap_service.results.origins import Origin
from fluoromap_service.results.points import alternative_positions


class CalibrationOut(BaseModel):
    """The gantry's self-calibration by the electrodes: the correction of view b against view a, beyond the headers."""

    applied: bool = Field(description="Whether the positions contain the correction.")
    rotation_deg: Position = Field(description="Rotation vector about the isocentre.")
    offset_mm: Position
    epipolar_before_px: float = Field(description="RMS distance between the two views' rays, in pixels.")
    epipolar_after_px: float


class ErrorBudgetOut(BaseModel):
    """The share of each source of error in an electrode's position: RMS over the study, 3D, from the isocentre."""

    pixels_mm: float
    angles_mm: float
    source_distances_mm: float
    phase_mismatch_mm: float
    breathing_mm: float


class AlternativeOut(BaseModel):
    """The position of an electrode under the other pairing of its site's catheters across the views."""

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


def study_geometry(triangulation: Triangulation, reference: str | None, origin: Origin) -> StudyGeometry:
    """Return the study's part of an answer.

    ``reference`` is the name of the reference catheter, where the study has one.
    """
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
        alternatives=[_alternative(*found) for found in alternative_positions(triangulation, reference, origin)],
    )  # fmt: skip


def _alternative(site: str, point: ElectrodePoint, position_mm: Array) -> AlternativeOut:
    x, y, z = _three(position_mm)
    return AlternativeOut(
        site=site, catheter=point.catheter, electrode=point.electrode, x_mm=x, y_mm=y, z_mm=z,
        probability=point.alternative_probability,
    )  # fmt: skip


def _three(vector: Array) -> Position:
    x, y, z = vector.tolist()
    return (x, y, z)
