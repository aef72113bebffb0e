"""The origin of coordinates in requests and answers."""

from __future__ import annotations

from typing import Annotated, Literal

from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field

from fluoromap_service.results.origins import Origin

Position = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]
"""The different elements of a symmetric 3x3 matrix: xx, xy, xz, yy, yz, zz."""

OriginQuery = Annotated[
    Origin,
    Query(
        description="`reference` subtracts the reference catheter's mean in the same frames; `isocentre` subtracts nothing."
    ),
]


class FrameOfReference(BaseModel):
    """Axes, origin and unit of the coordinates in the same answer."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"axes": "LPS", "origin": "reference", "unit": "mm"}]})

    axes: Literal["LPS"] = Field("LPS", description="+X to the patient's left, +Y to the back, +Z to the head.")
    origin: Origin
    unit: Literal["mm"] = "mm"
