"""The route of the catalogue of catheter types."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from fluoromap.catheters import CATHETER_TYPES, catheter_type
from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader

router = new_router(tags=["studies"])


class CatheterType(BaseModel):
    """A type of catheter; electrode 1 is the tip."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "name": "quadripolar-2-5-2", "electrodes": 4, "spacing_mm": [3.5, 6.0, 3.0],
                    "edge_spacing_mm": [2.0, 5.0, 2.0], "tip_mm": 2.0, "ring_mm": 1.0,
                }
            ]
        }
    )  # fmt: skip

    name: str = Field(description="The `type` of a catheter in a request.")
    electrodes: int
    spacing_mm: list[float] = Field(
        description="From electrode centre to electrode centre along the shaft, from the tip on."
    )
    edge_spacing_mm: list[float] = Field(description="From electrode edge to electrode edge, as on labels.")
    tip_mm: float = Field(description="Length of the tip electrode.")
    ring_mm: float = Field(description="Length of each ring along the shaft.")


def _shape(name: str) -> CatheterType:
    gaps, tip_mm, ring_mm = CATHETER_TYPES[name]
    catheter = catheter_type(name, name)
    return CatheterType(
        name=name,
        electrodes=catheter.electrodes,
        spacing_mm=list(catheter.spacing_mm),
        edge_spacing_mm=list(gaps),
        tip_mm=tip_mm,
        ring_mm=ring_mm,
    )


@router.get("/v1/catheter-types", responses=responses(400, 401, 403, 422))
def list_catheter_types(pages: Pages, caller: Reader) -> Page[CatheterType]:
    """List the types of catheters that a study can name instead of lengths."""
    return pages.page_of_all(list(CATHETER_TYPES), _shape, lambda name: name)
