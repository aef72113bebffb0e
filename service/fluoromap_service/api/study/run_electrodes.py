"""The route of the electrodes in all frames of a run."""

from __future__ import annotations

from dataclasses import asdict

from pydantic import BaseModel, Field

from fluoromap_service.api.http.paths import InstanceUid, StudyId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.study.electrodes import ElectrodeOut
from fluoromap_service.results.detections import detections_of_run
from fluoromap_service.store.engine import reading
from fluoromap_service.study import corrections, instances

router = new_router("/v1/studies/{study_id}/instances", tags=["electrodes"])


class FrameElectrodes(BaseModel):
    """The electrodes of one frame."""

    frame: int = Field(description="Counted from 1.")
    electrodes: list[ElectrodeOut]


@router.get("/{uid}/electrodes", responses=responses(401, 403, 404, 422))
def get_run_electrodes(study_id: StudyId, uid: InstanceUid, caller: Reader) -> list[FrameElectrodes]:
    """Return the electrodes of each frame that has any.

    A catheter that a person marked in a frame is as marked; the others are as the newest job detected them.
    """
    with reading() as session:
        instances.run_of(session, study_id, uid)
        by_hand = corrections.of_study(session, study_id).get(uid, {})
        frames = {
            number: [ElectrodeOut(**asdict(electrode), source="automatic") for electrode in detected]
            for number, detected in enumerate(detections_of_run(session, study_id, uid), start=1)
            if detected
        }
    for number, marked in by_hand.items():
        names = {electrode.catheter for electrode in marked}
        frames[number] = [
            *(electrode for electrode in frames.get(number, []) if electrode.catheter not in names),
            *(ElectrodeOut(**electrode.model_dump(), source="manual") for electrode in marked),
        ]
    return [FrameElectrodes(frame=number, electrodes=frames[number]) for number in sorted(frames)]
