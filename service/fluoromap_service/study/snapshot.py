"""A job's frozen input: everything that its stages read, so that later edits never touch a running job."""

from __future__ import annotations

import functools
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from fluoromap.catheters import Catalogue
from fluoromap.contracts import View
from fluoromap.geometry import Camera, Gantry, camera_from_gantry
from fluoromap.reasons import Reason
from fluoromap_service.study.catheters import StudyCatheter


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PluginSnapshot(_Frozen):
    """A plugin with its version and complete parameters."""

    name: str
    version: str
    params: dict[str, Any]


class GantrySnapshot(_Frozen):
    """Effective gantry of a run: the header's values, completed and overridden by the study's.

    ``table_offset_mm`` is the displacement of the table, and of the patient on it, since the study's first run with a known
    table position: along the patient's axes (LPS), zero where the position is unknown.
    """

    primary_deg: float
    secondary_deg: float
    source_detector_mm: float
    source_isocentre_mm: float
    pixel_spacing_mm: tuple[float, float]
    rows: int
    columns: int
    image_axes: tuple[tuple[int, int], tuple[int, int]]
    table_offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def position(self) -> Gantry:
        """Return the position of source and detector about the isocentre."""
        return Gantry(**self.model_dump(exclude={"table_offset_mm"}))

    def camera(self) -> Camera:
        """Return the camera in the study's frame, which moves with the patient.

        The origin is the place in the patient where the isocentre was during the first run.
        """
        return _camera(self)

    @property
    def px_per_mm(self) -> float:
        """Pixels per millimetre at the isocentre, wherever the table is."""
        return _px_per_mm(self)


# The keys of all stages of a job contain these, and after a correction hardly any gantry is new.
@functools.lru_cache(maxsize=1024)
def _camera(gantry: GantrySnapshot) -> Camera:
    camera = camera_from_gantry(gantry.position())
    return camera.translated(gantry.table_offset_mm) if any(gantry.table_offset_mm) else camera


@functools.lru_cache(maxsize=1024)
def _px_per_mm(gantry: GantrySnapshot) -> float:
    return camera_from_gantry(gantry.position()).px_per_mm


class CorrectedElectrode(_Frozen):
    """One electrode set by hand."""

    catheter: str
    electrode: int
    u_px: float
    v_px: float
    sd_px: float


class RunSnapshot(_Frozen):
    """One run: hash of the stored file, its facts, its geometry, and the corrected frames (counted from 1)."""

    sha256: str
    facts: dict[str, Any]
    gantry: GantrySnapshot
    corrections: dict[int, tuple[CorrectedElectrode, ...]]


class SiteSnapshot(_Frozen):
    """A ready site: two runs and an activation time; ``doubts``: why its positions deserve less trust."""

    site: str
    lat_ms: float
    lat_sd_ms: float
    view_a: str
    view_b: str
    bound_by: str = "explicit"
    doubts: tuple[Reason, ...] = ()

    def run(self, view: View) -> str:
        """Return the SOP Instance UID of a view."""
        return self.view_a if view == "a" else self.view_b


class RejectedSiteSnapshot(_Frozen):
    """A site that was not ready when the job was made, and why."""

    site: str
    lat_ms: float | None
    view_a: str | None
    view_b: str | None
    reasons: tuple[Reason, ...]


class Snapshot(_Frozen):
    """The whole input of a job."""

    study: str
    catheters: tuple[StudyCatheter, ...]
    reference: str | None
    mapping: str
    segmenter: PluginSnapshot
    triangulator: PluginSnapshot
    monoplane: PluginSnapshot
    fuser: PluginSnapshot
    view: Literal["a", "b", "both"]
    runs: dict[str, RunSnapshot]
    sites: tuple[SiteSnapshot, ...]
    rejected: tuple[RejectedSiteSnapshot, ...]

    @functools.cached_property
    def catalogue(self) -> Catalogue:
        """The catheters with their roles."""
        return Catalogue(tuple(each.catheter() for each in self.catheters), self.reference, self.mapping)

    @property
    def views(self) -> tuple[View, ...]:
        """The views that the job tracks frame by frame."""
        return ("a", "b") if self.view == "both" else (self.view,)

    def site(self, name: str) -> SiteSnapshot:
        """Return the ready site of a name."""
        return next(site for site in self.sites if site.site == name)
