"""A job's points as the store holds them, and the positions of alternative pairings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from fluoromap.contracts import Array, ElectrodePoint, LocatedSite, Triangulation
from fluoromap_service.results.finished import done_stage
from fluoromap_service.results.origins import Origin
from fluoromap_service.store.models import Job, Point


def point_rows(session: Session, job: Job) -> Sequence[Point]:
    """Return all points of a job, located or rejected.

    Raises
    ------
    Problem
        409 ``not_ready`` before the stage ``triangulate`` is done.
    """
    done_stage(session, job, "triangulate")
    return session.scalars(select(Point).where(Point.job_id == job.id).order_by(Point.id)).all()


def alternative_positions(
    triangulation: Triangulation, reference: str | None, origin: Origin
) -> Iterator[tuple[str, ElectrodePoint, Array]]:
    """Return the electrodes that the other pairing of the catheters would put elsewhere.

    Parameters
    ----------
    triangulation : Triangulation
    reference : str or None
        Name of the reference catheter, where the study has one.
    origin : Origin

    Returns
    -------
    iterator of (site, point, position)
        The position (3,) in mm from ``origin`` under the other pairing. A site without a located reference catheter has none
        from the origin ``reference``.
    """
    for site in triangulation.sites:
        zero_mm = np.zeros(3) if origin is Origin.ISOCENTRE else _alternative_reference_mm(site, reference)
        if zero_mm is None:
            continue
        for point in site.points:
            if point.alternative_mm is not None:
                yield site.site, point, point.alternative_mm - zero_mm


def _alternative_reference_mm(site: LocatedSite, reference: str | None) -> Array | None:
    """Return the reference catheter's origin (3,) under the other pairing.

    That pairing may move this catheter too.
    """
    if site.reference_mm is None:
        return None
    moves = [
        np.zeros(3) if point.alternative_mm is None else point.alternative_mm - point.position_mm
        for point in site.points
        if point.catheter == reference
    ]
    shifted: Array = site.reference_mm + np.mean(moves, axis=0)
    return shifted
