"""The route of the activation-time table."""

from __future__ import annotations

from fastapi import Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool

from fluoromap_service.api.http.paths import StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Writer
from fluoromap_service.api.study.csv_input import activation_times, csv_body, csv_text
from fluoromap_service.store.engine import writing
from fluoromap_service.study import sites, studies

router = new_router("/v1/studies/{study_id}", tags=["sites"])


class TableOut(BaseModel):
    """The effect of a table."""

    sites: int = Field(description="Sites in the table.", examples=[12])
    unmatched: list[str] = Field(
        description="Sites of the table without runs, until the runs come.", examples=[["S12"]]
    )


@router.put(
    "/activation-times",
    responses=responses(400, 401, 403, 404, 413, 415, 422),
    openapi_extra=csv_body("site,lat_ms\nS01,12.5\nS02,41\n"),
)
async def put_activation_times(study_id: StudyId, request: Request, caller: Writer) -> TableOut:
    """Replace the activation-time table: `site,lat_ms` and optionally `view_a,view_b`; all or nothing.

    An activation time is the mapping catheter's time minus the reference's. The table may come before the runs.
    """
    text = await csv_text(request)

    def act() -> TableOut:
        with writing() as session:
            study = studies.lock(session, study_id)
            table = activation_times(text)
            unmatched = sites.put_table(session, study, table)
            return TableOut(sites=len(table), unmatched=unmatched)

    return await run_in_threadpool(act)
