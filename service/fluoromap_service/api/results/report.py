"""The route of a job's report."""

from __future__ import annotations

from fastapi import Request, Response

from fluoromap_service.api.http.etags import file_response
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.report_page import report_of

router = new_router(tags=["results"])

POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src data:; "
    "form-action 'none'; frame-ancestors 'none'; base-uri 'none'"
)
"""Content-Security-Policy of the report, which contains its scripts and pictures and loads nothing."""


@router.get(
    "/v1/jobs/{job_id}/report.html",
    summary="Everything on one page",
    response_class=Response,
    responses={
        200: {"content": {"text/html": {"schema": {"type": "string"}}}, "description": "A page that needs no network."},
        304: {"description": "Unchanged since the ETag sent."},
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_report(job_id: JobId, request: Request, caller: Reader) -> Response:
    """Return the report of a job as one HTML file.

    The file has no links to other files. The answer is 409 until the job has ended. The page contains pictures, a 3D
    view, tables with grades and reasons, the error budget, parameters, versions and the hashes of the input files.
    """
    page = report_of(job_id)
    response = file_response(request, page.path, page.sha256, "text/html", f"report-{job_id}.html", inline=True)
    response.headers["Content-Security-Policy"] = POLICY
    return response
