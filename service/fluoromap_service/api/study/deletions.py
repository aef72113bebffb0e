"""The route of the certificates of deleted studies."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from fluoromap_service.api.http.paths import StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.http.timestamps import rfc3339
from fluoromap_service.store.engine import reading
from fluoromap_service.study.deletion import certificate_of

router = new_router("/v1/deletions", tags=["studies"])


class AuditReference(BaseModel):
    """The entry of the audit trail that holds the certificate's hash."""

    entry: int
    what: str
    hash: str


class Certificate(BaseModel):
    """The certificate of a deleted study: ids, hashes and numbers, without patient data."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "study": "0d9e8f7a6b5c4d3e2f1a0b9c8d7e6f5a", "deleted": "2026-03-01T09:30:00.000Z", "by": "clinic",
                    "jobs": ["7f0c5b1e9a3d4c27b4a1f1f5d6e7a809"], "files": ["9f86d081884c7d65"], "runs_deleted": 2,
                    "runs_of_other_studies": 0, "sites": 1, "corrections": 0, "reidentification_table": False,
                    "files_left": [], "certificate_sha256": "60303ae22b998861",
                    "audit": {"entry": 17, "what": "delete study; certificate 60303ae22b998861", "hash": "2c26b46b68ffc68f"},
                }
            ]
        }
    )  # fmt: skip

    study: str
    deleted: str
    by: str = Field(description="The caller, or `retention`.")
    jobs: list[str] = Field(description="Ids of the deleted jobs.")
    files: list[str] = Field(description="SHA-256 of each deleted file: runs, results and pictures.")
    runs_deleted: int
    runs_of_other_studies: int = Field(description="Runs that stay, because other studies refer to them.")
    sites: int
    corrections: int = Field(description="Versions of electrodes that were set by hand.")
    reidentification_table: bool = Field(description="Whether a table that leads back from exports went too.")
    files_left: list[str] = Field(
        description="Files of the list that are still on the disk at this moment; the clean-up removes them within the hour."
    )
    certificate_sha256: str
    audit: AuditReference


@router.get("/{study_id}", summary="Certificate of a deletion", responses=responses(401, 403, 404))
def get_deletion(study_id: StudyId, caller: Reader) -> Certificate:
    """Return what went when a study was deleted.

    The audit trail holds the hash of the certificate.
    """
    with reading() as session:
        certificate = certificate_of(session, study_id)
    return Certificate(deleted=rfc3339(certificate.pop("at")), **certificate)
