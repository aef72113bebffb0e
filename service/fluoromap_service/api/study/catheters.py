"""Catheters in requests."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, JsonValue, StringConstraints, model_validator

from fluoromap.catheters import CATHETER_TYPES, Catheter, catheter_type
from fluoromap_service.store.names import NORMAL_FORM

Line = Annotated[str, StringConstraints(pattern=r"^[^\x00-\x1f\x7f]*[^\x00-\x20\x7f][^\x00-\x1f\x7f]*$")]
"""Text of one line that is not blank."""
CatheterName = Annotated[Line, NORMAL_FORM]
MOST_CATHETERS = 6
MOST_ELECTRODES = 20
Millimetres = Annotated[float, Field(gt=0, le=100, allow_inf_nan=False)]

_EXAMPLES: list[JsonValue] = [
    {"name": "reference", "electrodes": 4, "spacing_mm": [3.5, 6.0, 3.0], "tip_mm": 2.0, "ring_mm": 1.0},
    {"name": "mapping", "electrodes": 4, "edge_spacing_mm": [2.0, 5.0, 2.0], "tip_mm": 4.0, "ring_mm": 1.3},
    {"name": "coronary sinus", "type": "decapolar-2-5-2"},
]


class CatheterIn(BaseModel):
    """A catheter by the name of its type, or as its maker describes it; electrode 1 is the tip."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": _EXAMPLES})
    name: CatheterName = Field(min_length=1, max_length=64)
    type: str | None = Field(
        None, max_length=64, description=f"Instead of electrodes and lengths, one of: {', '.join(CATHETER_TYPES)}."
    )
    electrodes: int | None = Field(None, ge=2, le=MOST_ELECTRODES)
    spacing_mm: list[Millimetres] | None = Field(
        None, description="From electrode centre to electrode centre along the shaft, from the tip on."
    )
    edge_spacing_mm: list[Millimetres] | None = Field(
        None, description="From electrode edge to electrode edge, as on labels (2-5-2); instead of spacing_mm."
    )
    tip_mm: Millimetres | None = Field(None, description="Length of the tip electrode.")
    ring_mm: Millimetres | None = Field(None, description="Length of each ring along the shaft.")

    @model_validator(mode="after")
    def _one_description(self) -> Self:
        self.catheter()
        return self

    def catheter(self) -> Catheter:
        """Return the catheter as the science takes it."""
        lengths = self.electrodes, self.tip_mm, self.ring_mm
        if self.type is not None:
            if any(value is not None for value in (*lengths, self.spacing_mm, self.edge_spacing_mm)):
                raise ValueError("give either a type or electrodes and lengths")
            return catheter_type(self.type, self.name)
        if self.electrodes is None or self.tip_mm is None or self.ring_mm is None:
            raise ValueError("give a type, or electrodes, tip_mm, ring_mm and a spacing")
        if (self.spacing_mm is None) == (self.edge_spacing_mm is None):
            raise ValueError("give either spacing_mm or edge_spacing_mm")
        if self.edge_spacing_mm is not None:
            return Catheter.from_edge_spacing(
                self.name, self.electrodes, tuple(self.edge_spacing_mm), self.tip_mm, self.ring_mm
            )
        return Catheter(self.name, self.electrodes, tuple(self.spacing_mm or ()), self.tip_mm, self.ring_mm)
