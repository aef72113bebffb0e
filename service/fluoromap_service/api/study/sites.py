"""The routes of mapping sites: their activation times and their runs."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from fluoromap_service.api.http.paging import Page, Pages
from fluoromap_service.api.http.paths import SiteName, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader, Writer
from fluoromap_service.api.study.csv_input import LARGEST_LAT_MS
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.study import sites, studies
from fluoromap_service.study.binding import BoundSite, binding_of, site_of

router = new_router("/v1/studies/{study_id}/sites", tags=["sites"])


class SiteOut(BaseModel):
    """A mapping site."""

    site: str | None = Field(
        description="Null for a pair of runs that nobody has named; name it by PUT with its views.", examples=["S03"]
    )
    pair: int | None = Field(
        description="Number of a pair without a name, in the order of acquisition.", examples=[None]
    )
    lat_ms: float | None = Field(description="Activation time, mapping minus reference.", examples=[41.0])
    view_a: str | None = Field(
        description="SOP Instance UID of the run nearer to lateral.", examples=["1.2.826.0.1.3680043.8.498.1"]
    )
    view_b: str | None = Field(examples=[None])
    bound_by: Literal["explicit", "csv", "upload", "order", "time"] | None = Field(examples=["time"])
    missing: list[str] = Field(
        description="The values that a job still needs: site, lat_ms, view_a, view_b, gantry:view_a, gantry:view_b.",
        examples=[["view_b"]],
    )
    warnings: list[str] = Field(
        description="Reasons why the pair is doubtful or a job will reject it.", examples=[["table_moved"]]
    )
    angle_deg: float | None = Field(
        description="Angle between the central rays of the two views, 0 to 90 degrees.", examples=[90.0]
    )
    ready: bool = Field(description="Whether a job can use the site.", examples=[False])


class SitePut(BaseModel):
    """Changes of a site; a member that is left out stays, null removes the value."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"lat_ms": 41.0}]})
    lat_ms: float | None = Field(None, ge=-LARGEST_LAT_MS, le=LARGEST_LAT_MS, allow_inf_nan=False)
    view_a: str | None = Field(None, max_length=64, description="SOP Instance UID.")
    view_b: str | None = Field(None, max_length=64, description="SOP Instance UID.")


def _shape(site: BoundSite) -> SiteOut:
    return SiteOut.model_validate(
        {
            "site": site.site,
            "pair": site.pair,
            "lat_ms": site.lat_ms,
            "view_a": site.view_a,
            "view_b": site.view_b,
            "bound_by": site.bound_by,
            "missing": list(site.missing),
            "warnings": list(site.warnings),
            "angle_deg": site.angle_deg,
            "ready": site.ready,
        }
    )


@router.get("", responses=responses(400, 401, 403, 404, 422))
def list_sites(study_id: StudyId, pages: Pages, caller: Reader) -> Page[SiteOut]:
    """List the study's sites in the order of first mention.

    The pairs of runs that have no name yet follow.
    """
    with reading() as session:
        binding = binding_of(session, study_id, runs=studies.runs_of(session, study_id))
        return pages.page_of_all((*binding.sites, *binding.pairs), _shape, lambda site: site.site or f"/{site.pair}")


@router.get("/{site}", responses=responses(401, 403, 404, 422))
def get_site(study_id: StudyId, site: SiteName, caller: Reader) -> SiteOut:
    """Return one site."""
    with reading() as session:
        return _shape(site_of(session, studies.get(session, study_id), site))


@router.put("/{site}", responses=responses(400, 401, 403, 404, 422))
def put_site(study_id: StudyId, site: SiteName, body: SitePut, caller: Writer) -> SiteOut:
    """Set a site's activation time or its runs.

    A site whose runs are a guess by row order (`paired_by_order`) keeps them, and the request confirms the guess for this
    site, unless the request names other runs.

    A job computes a pair between 20 and 30 degrees, and its covariance shows the uncertainty. A job rejects a pair under 20
    degrees.
    """
    with writing() as session:
        study = studies.lock(session, study_id)
        views = body.model_dump(include={"view_a", "view_b"}, exclude_unset=True)
        sites.confirm_order(session, study, site, views)
        row = sites.mention(session, study_id, site)
        if "lat_ms" in body.model_fields_set:
            row.lat_ms, row.lat_sd_ms = body.lat_ms, None
            row.lat_by = None if body.lat_ms is None else "explicit"
        sites.put_views(session, study, site, views)
        return _shape(site_of(session, study, site, also_empty=True))
