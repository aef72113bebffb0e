"""Where coordinates are counted from, and how answers say so."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field

Position = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


class Origin(StrEnum):
    """Origin of coordinates; the axes are always DICOM patient axes (LPS)."""

    REFERENCE = "reference"
    ISOCENTRE = "isocentre"


OriginQuery = Annotated[
    Origin,
    Query(description="`reference`: the reference catheter's mean in the same frames is subtracted; or the isocentre."),
]


class FrameOfReference(BaseModel):
    """Axes, origin and unit of the coordinates beside it."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"axes": "LPS", "origin": "reference", "unit": "mm"}]})

    axes: Literal["LPS"] = Field("LPS", description="+X to the patient's left, +Y to the back, +Z to the head.")
    origin: Origin
    unit: Literal["mm"] = "mm"
