"""A check of the whole store: files without a row, rows without a file, damaged content; and the repair."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import delete, exists, or_, select

from fluoromap_service.store import files
from fluoromap_service.store.engine import reading, writing
from fluoromap_service.store.models import File, Instance, Rendering, StageResult, StageRow
from fluoromap_service.study.instances import unlink_unreferenced
from fluoromap_service.study.orphans import SETTLED_SECONDS, orphans


@dataclass(frozen=True, slots=True)
class Findings:
    """The faults of the store.

    Parameters
    ----------
    abandoned : int
        Files that never arrived whole; already removed.
    orphans : tuple of str
        Hashes of the files without a row.
    unused : tuple of str
        Hashes of the rows of files that nothing refers to.
    broken_runs : tuple of str
        SOP Instance UIDs of the runs whose file is missing or damaged. Only an upload mends them.
    broken_results : tuple of str
        Hashes of damaged results and pictures. The service computes them again when a new job or request needs them.
    jobs : tuple of str
        Jobs with such a result; start each of them anew to read it.
    """

    abandoned: int
    orphans: tuple[str, ...]
    unused: tuple[str, ...]
    broken_runs: tuple[str, ...]
    broken_results: tuple[str, ...]
    jobs: tuple[str, ...]


def examine(settled_seconds: float = SETTLED_SECONDS) -> Findings:
    """Read every file of the store and compare it with the rows."""
    abandoned = files.remove_abandoned()
    with reading() as session:
        rows = set(session.scalars(select(File.sha256)))
        references = Instance.sha256, StageRow.result, StageResult.sha256, Rendering.sha256
        used = or_(*(exists(select(column).where(column == File.sha256)) for column in references))
        unused = tuple(sorted(session.scalars(select(File.sha256).where(~used))))
    broken = sorted(sha256 for sha256 in rows if not _has_its_hash(sha256))
    with reading() as session:
        pairs = session.execute(select(Instance.sha256, Instance.sop_instance_uid)).all()
        runs = {row.sha256: row.sop_instance_uid for row in pairs}
        jobs = {
            job
            for sha256 in broken
            for job in session.scalars(select(StageRow.job_id).where(StageRow.result == sha256))
        }
    return Findings(
        abandoned,
        tuple(sorted(orphans(settled_seconds))),
        unused,
        tuple(sorted(runs[sha256] for sha256 in broken if sha256 in runs)),
        tuple(sha256 for sha256 in broken if sha256 not in runs),
        tuple(sorted(jobs)),
    )


def mend(findings: Findings) -> None:
    """Remove orphans and unused files, and forget damaged results.

    A new job computes a forgotten result again.
    """
    unlink_unreferenced(findings.orphans)
    with writing() as session:
        files.lock(session)
        unreferenced = [path.name for path in files.remove_unreferenced(session, findings.unused)]
    unlink_unreferenced(unreferenced)
    with writing() as session:
        files.lock(session)
        for sha256 in findings.broken_results:
            session.execute(delete(StageResult).where(StageResult.sha256 == sha256))
            session.execute(delete(Rendering).where(Rendering.sha256 == sha256))


def _has_its_hash(sha256: str) -> bool:
    try:
        return files.sha256_of(files.path_of(sha256)) == sha256
    except FileNotFoundError:
        return False
