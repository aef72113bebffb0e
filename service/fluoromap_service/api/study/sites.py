"""Mapping sites: their activation times and the runs bound to them."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.paths import SiteName, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.study.csv_input import LARGEST_LAT_MS
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.study import sites, studies
from fluoromap_service.study.sites import BoundSite

router = APIRouter(prefix="/v1/studies/{study_id}/sites", tags=["sites"])


class SiteOut(BaseModel):
    """A mapping site."""

    site: str = Field(examples=["S03"])
    lat_ms: float | None = Field(description="Activation time, mapping minus reference.", examples=[41.0])
    view_a: str | None = Field(
        description="SOP Instance UID of the run nearer to lateral.", examples=["1.2.826.0.1.3680043.8.498.1"]
    )
    view_b: str | None = Field(examples=[None])
    bound_by: Literal["explicit", "csv", "upload", "order", "time"] | None = Field(examples=["time"])
    missing: list[str] = Field(
        description="Of lat_ms, view_a, view_b, gantry:view_a, gantry:view_b.", examples=[["view_b"]]
    )
    warnings: list[str] = Field(description="Why the pair is doubtful or will be rejected.", examples=[["table_moved"]])


class SitePut(BaseModel):
    """What to set; members left out stay, null sets free."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"lat_ms": 41.0}]})
    lat_ms: float | None = Field(None, ge=-LARGEST_LAT_MS, le=LARGEST_LAT_MS, allow_inf_nan=False)
    view_a: str | None = Field(None, max_length=64, description="SOP Instance UID.")
    view_b: str | None = Field(None, max_length=64, description="SOP Instance UID.")


def _shape(site: BoundSite) -> SiteOut:
    return SiteOut.model_validate(
        {
            "site": site.site,
            "lat_ms": site.lat_ms,
            "view_a": site.view_a,
            "view_b": site.view_b,
            "bound_by": site.bound_by,
            "missing": list(site.missing),
            "warnings": list(site.warnings),
        }
    )


@router.get("", responses=responses(400, 401, 403, 404, 422))
def list_sites(study_id: StudyId, pages: Pages, caller: Reader) -> Page[SiteOut]:
    """The study's sites in the order of first mention."""
    with reading() as session:
        bound = sites.resolve(session, studies.get(session, study_id))
        return pages.page_of_all(bound, _shape, lambda site: site.site)


@router.get("/{site}", responses=responses(401, 403, 404, 422))
def get_site(study_id: StudyId, site: SiteName, caller: Reader) -> SiteOut:
    """One site."""
    with reading() as session:
        return _shape(sites.one(session, studies.get(session, study_id), site))


@router.put("/{site}", responses=responses(400, 401, 403, 404, 422))
def put_site(study_id: StudyId, site: SiteName, body: SitePut, caller: Writer) -> SiteOut:
    """Set a site's activation time, or the runs that show it; what is set here comes before every other rule.

    A pair between 20 and 30 degrees is computed, its covariance tells how well; under 20 it is rejected.
    """
    told = body.model_fields_set
    with writing() as session:
        study = studies.lock(session, study_id)
        sites.settle(session, study)
        row = sites.mention(session, study_id, site)
        if "lat_ms" in told:
            row.lat_ms, row.lat_sd_ms = body.lat_ms, None
            row.lat_by = None if body.lat_ms is None else "explicit"
        views = body.model_dump(include={"view_a", "view_b"}, exclude_unset=True)
        sites.put_views(session, study, site, views)
        return _shape(sites.one_or_empty(session, study, site))
