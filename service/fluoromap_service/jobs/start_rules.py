"""The rules that start a job by themselves, and when a study fulfils one."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from sqlalchemy.orm import Session

from fluoromap_service.configuration import read_table
from fluoromap_service.study.binding import BoundSite, binding_of, rows_of
from fluoromap_service.study.freeze import PipelineRequest, check_pipeline
from fluoromap_service.study.instances import runs_of


class StartRule(BaseModel):
    """What a study from a DICOM door must have before a job starts by itself."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    sites: int | None = Field(None, ge=1)
    """Number of sites of a whole study. None: the table of activation times lists them."""
    runs_per_site: int = Field(2, ge=2)
    activation_times: bool = True
    geometry: bool = True
    quiet_seconds: float | None = Field(None, gt=0)
    """Silence after which a job starts with the sites that are ready. None: never."""
    view: Literal["a", "b", "both"] = "both"
    pipeline: PipelineRequest = PipelineRequest()

    def holds(self, session: Session, study_id: str) -> bool:
        """Return whether everything that the rule names is there."""
        binding = binding_of(session, study_id)
        names = {site.site for site in binding.sites}
        listed = {row.name for row in rows_of(session, study_id) if row.csv_row is not None}
        # A pair without a name is a site that nobody has described yet.
        if not names or binding.pairs or (self.sites is None and names != listed):
            return False
        runs_needed = max(self.sites or 0, len(names)) * self.runs_per_site
        return (
            len(names) >= (self.sites or 0)
            and len(runs_of(session, study_id)) >= runs_needed
            and all(self._is_complete(site) for site in binding.sites)
        )

    def allows_silence_of(self, seconds: float) -> bool:
        """Return whether a job may start with the ready sites after a silence."""
        return self.quiet_seconds is not None and seconds >= self.quiet_seconds

    def _is_complete(self, site: BoundSite) -> bool:
        return not any(
            item in ("view_a", "view_b")
            or (self.activation_times and item == "lat_ms")
            or (self.geometry and item.startswith("gantry:"))
            for item in site.missing
        )


def read_rules() -> tuple[StartRule, ...]:
    """Return the rules of the configuration file.

    Raises
    ------
    Problem
        422 ``invalid_configuration``, or as ``check_pipeline``.
    """
    rules = tuple(read_table("rules", TypeAdapter(StartRule)).values())
    for rule in rules:
        check_pipeline(rule.pipeline)
    return rules
