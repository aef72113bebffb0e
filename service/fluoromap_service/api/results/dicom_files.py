"""The route of a job's results as DICOM."""

from __future__ import annotations

from fastapi import Request, Response

from fluoromap_service.api.http.etags import file_response
from fluoromap_service.api.http.middleware.download_limit import LARGE_DOWNLOAD
from fluoromap_service.api.http.paths import JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.result_objects import objects_zip

router = new_router(tags=["results"])


@router.get(
    "/v1/jobs/{job_id}/dicom",
    dependencies=[LARGE_DOWNLOAD],
    summary="The results as DICOM objects",
    response_class=Response,
    responses={
        200: {
            "content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}},
            "description": "A zip.",
        },
        304: {"description": "Unchanged since the ETag sent."},
        **responses(401, 403, 404, 409, 422, 429),
    },
)
def get_dicom(job_id: JobId, request: Request, caller: Reader) -> Response:
    """Return the results of a job as DICOM files in a zip.

    The zip contains `report.dcm` (Comprehensive 3D SR), and where the job has a map `overlays-1.dcm` and `map.dcm`
    (secondary captures) and `chamber.dcm` (encapsulated STL). The answer is 409 until the job has ended. The same job
    gives the same bytes.
    """
    kept = objects_zip(job_id)
    return file_response(request, kept.path, kept.sha256, "application/zip", f"fluoromap-{job_id}-dicom.zip")
