"""The route of the reason codes."""

from __future__ import annotations

from pydantic import BaseModel, Field

from fluoromap.reasons import Reason
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader

router = new_router(tags=["service"])


class ReasonOut(BaseModel):
    """A reason code with its explanation."""

    code: Reason = Field(examples=["no_electrodes"])
    sentence: str = Field(description="The event and the remedy, in words.")


@router.get("/v1/reasons", summary="Reason codes", responses=responses(401, 403))
def list_reasons(caller: Reader) -> list[ReasonOut]:
    """List all reason codes with their sentences."""
    return [ReasonOut(code=reason, sentence=reason.sentence) for reason in Reason]
