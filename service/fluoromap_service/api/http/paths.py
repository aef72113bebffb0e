"""The parameters of paths that several routes share."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path

from fluoromap_service.store.names import Name

StudyId = Annotated[str, Path(description="The study's id.")]
JobId = Annotated[str, Path(description="The job's id.")]
DeliveryId = Annotated[str, Path(description="The delivery's id.")]
InstanceUid = Annotated[str, Path(description="SOP Instance UID of the run.", max_length=64)]
FrameNumber = Annotated[int, Path(ge=1, description="Frame of the run, counted from 1.")]
SiteName = Annotated[Name, Path(description="The site's name.", max_length=64)]
