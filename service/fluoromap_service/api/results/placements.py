"""The route of the map's place in every frame of a run, from which a viewer draws the map over a playing cine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from fluoromap.contracts import Array, NamedChain
from fluoromap_service.api.http.paths import InstanceUid, JobId
from fluoromap_service.api.http.problems import responses
from fluoromap_service.api.http.routers import new_router
from fluoromap_service.api.http.security import Reader
from fluoromap_service.api.results.origins import Position
from fluoromap_service.dicom import InstanceFacts
from fluoromap_service.results.finished import job_of
from fluoromap_service.results.placement import placement_of
from fluoromap_service.store.engine import reading

router = new_router(tags=["results"])

Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class FrameElectrode(BaseModel):
    """An electrode in one frame."""

    catheter: str
    electrode: int = Field(description="1 is the tip.")
    u_px: float
    v_px: float


class FramePlace(BaseModel):
    """The place of the map in one frame."""

    frame: int = Field(description="Counted from 1.")
    shift_mm: Position = Field(description="World minus map: the reference catheter's position in this frame.")
    tip_px: tuple[float, float] | None = Field(description="Pixel (u, v) of the mapping tip.")
    electrodes: list[FrameElectrode] = Field(
        description="The electrodes that the job used in this frame, some of them interpolated between frames."
    )


class Placement(BaseModel):
    """The camera of a run, and the place of the map in each of its frames."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "sop_instance_uid": "1.2.826.0.1.3680043.8.498.1",
                    "site": "S03",
                    "view": "a",
                    "frame": 37,
                    "projection": [
                        [0.0, -1707.0, 0.0, 191488.0],
                        [0.0, 0.0, -1707.0, 191488.0],
                        [1.0, 0.0, 0.0, 750.0],
                    ],
                    "frames": [
                        {
                            "frame": 1,
                            "shift_mm": [2.1, -14.0, 7.5],
                            "tip_px": [301.5, 244.0],
                            "electrodes": [{"catheter": "mapping", "electrode": 1, "u_px": 301.5, "v_px": 244.0}],
                        }
                    ],
                }
            ]
        }
    )

    sop_instance_uid: str
    site: str
    view: Literal["a", "b"]
    frame: int = Field(description="The diastolic frame, counted from 1.")
    projection: Annotated[list[Row], Field(min_length=3, max_length=3)] = Field(
        description="Matrix P with w (u, v, 1) = P (x, y, z, 1); (x, y, z) is a point of the map, counted from the "
        "reference catheter, plus the shift of the frame; w is its distance from the source along the central ray, mm."
    )
    frames: list[FramePlace]


@router.get(
    "/v1/jobs/{job_id}/overlays/{uid}/placement",
    summary="Place of the map in every frame of a run",
    response_model=Placement,
    responses=responses(401, 403, 404, 409, 422),
)
def get_placement(job_id: JobId, uid: InstanceUid, caller: Reader) -> Placement:
    """Return the camera of a run and the shift of the map in each frame.

    With them a viewer draws the map of `GET /v1/jobs/{job_id}/map` over the stored pixels as the overlays show it.
    """
    with reading() as session:
        placement = placement_of(session, job_of(session, job_id), uid)
    count = InstanceFacts.from_json(placement.snapshot.runs[uid].facts).frames
    return Placement(
        sop_instance_uid=uid,
        site=placement.view.site,
        view=placement.view.view,
        frame=placement.view.frame + 1,
        projection=placement.camera.matrix.tolist(),
        frames=[
            FramePlace(
                frame=frame + 1,
                shift_mm=placement.shift_mm(frame).tolist(),
                tip_px=_pixel(placement.tip_uv(frame)),
                electrodes=_electrodes(placement.shown(frame)),
            )
            for frame in range(count)
        ],
    )


def _electrodes(chains: Mapping[str, NamedChain]) -> list[FrameElectrode]:
    return [
        FrameElectrode(catheter=name, electrode=electrode, u_px=u, v_px=v)
        for name, chain in chains.items()
        for electrode, (u, v) in zip(chain.electrodes, chain.pixels_uv.tolist(), strict=True)
    ]


def _pixel(uv: Array | None) -> tuple[float, float] | None:
    if uv is None:
        return None
    u, v = uv.tolist()
    return u, v
