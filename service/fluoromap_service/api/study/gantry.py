"""Gantry values in requests and answers, of one run or of a whole study."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from fluoromap.geometry import LEAST_SOURCE_MM
from fluoromap_service.dicom.facts import TableOrigin
from fluoromap_service.problem import Problem
from fluoromap_service.study.instances import GANTRY_KEYWORDS, is_behind_detector

Spacing = Annotated[float, Field(ge=0.01, le=5, allow_inf_nan=False)]


class GantryOut(BaseModel):
    """Gantry values; null where unknown."""

    primary_deg: float | None = Field(description="LAO positive, RAO negative.", examples=[-90.0])
    secondary_deg: float | None = Field(description="Cranial positive, caudal negative.", examples=[0.0])
    source_detector_mm: float | None = Field(examples=[1000.0])
    source_isocentre_mm: float | None = Field(examples=[750.0])
    pixel_spacing_mm: list[float] | None = Field(
        description="[row, column] spacing at the detector (ImagerPixelSpacing).", examples=[[0.3, 0.3]]
    )


class RunGantryOut(GantryOut):
    """Gantry values of a run, with the position of the table."""

    table_mm: list[float] | None = Field(
        description="[x, y, z] of the table along the patient's axes (LPS). Only differences between runs with the same "
        "`table_origin` have a meaning.",
        examples=[[9.2, 84.0, 503.9]],
    )
    table_origin: TableOrigin | None = Field(
        description="The attributes that state `table_mm`: `isocentre` (TableXPositionToIsocenter ff.), `table_top` "
        "(TableTopVerticalPosition ff.) or `ge` (the private block of GE)."
    )


class GantryPatch(BaseModel):
    """Gantry values that complete or override others; null removes the value.

    Each name may be its DICOM keyword instead, as the list `missing` of a run gives it.
    """

    model_config = ConfigDict(extra="forbid")
    primary_deg: float | None = Field(None, ge=-180, le=180, allow_inf_nan=False)
    secondary_deg: float | None = Field(None, ge=-90, le=90, allow_inf_nan=False)
    source_detector_mm: float | None = Field(None, ge=LEAST_SOURCE_MM, le=3000, allow_inf_nan=False)
    source_isocentre_mm: float | None = Field(None, ge=LEAST_SOURCE_MM, le=3000, allow_inf_nan=False)
    pixel_spacing_mm: tuple[Spacing, Spacing] | None = None

    @model_validator(mode="before")
    @classmethod
    def _rename_keywords(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        names = {keyword: field for field, keyword in GANTRY_KEYWORDS.items()}
        for keyword, field in names.items():
            if keyword in given and field in given:
                raise ValueError(f"{field} and {keyword} are the same value; give one of them")
        # A strict reader takes a tuple here, and JSON has lists only.
        return {
            names.get(name, name): tuple(value) if isinstance(value, list) else value for name, value in given.items()
        }


def changed_gantry(before: dict[str, Any], change: GantryPatch | None) -> dict[str, Any]:
    """Return stored gantry values after a change; None removes all of them."""
    if change is None:
        return {}
    after = {**before, **change.model_dump(mode="json", exclude_unset=True)}
    return {name: value for name, value in after.items() if value is not None}


def check_gantry(values: dict[str, Any]) -> None:
    """Check that gantry values do not contradict each other.

    Raises
    ------
    Problem
        422 ``invalid_gantry``.
    """
    if is_behind_detector(values):
        places = [("body.gantry.source_isocentre_mm", "the isocentre lies between source and detector")]
        raise Problem(422, "invalid_gantry", "These gantry values contradict each other; see 'errors'.", places)
