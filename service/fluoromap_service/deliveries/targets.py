"""The targets of deliveries."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import AnyHttpUrl, BaseModel, ConfigDict, Field, TypeAdapter

from fluoromap_service.configuration import read_table

JobEnd = Literal["succeeded", "failed", "cancelled"]


class _Target(BaseModel):
    """The members that all kinds of targets have."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    job_ends: tuple[JobEnd, ...] = ("succeeded",)
    """The ends of jobs after which the results are sent without a request."""
    first_wait_seconds: float = Field(5.0, gt=0)
    longest_wait_seconds: float = Field(3600.0, gt=0)
    give_up_days: float = Field(7.0, gt=0)
    timeout_seconds: float = Field(120.0, gt=0)

    def wait_seconds(self, failures: int) -> float:
        """Return the wait after so many failures in a row; each doubles it."""
        return float(min(self.first_wait_seconds * 2.0 ** min(failures - 1, 60), self.longest_wait_seconds))


class CStoreTarget(_Target):
    """A DICOM node that receives the result objects by C-STORE."""

    kind: Literal["dicom"]
    host: str = Field(min_length=1)
    port: int = Field(ge=1, le=65535)
    aet: str = Field(pattern=r"^[!-\[\]-~]{1,16}$")
    calling_aet: str | None = Field(None, pattern=r"^[!-\[\]-~]{1,16}$")
    tls: bool = False
    ca_file: Path | None = None
    certificate_file: Path | None = None
    key_file: Path | None = None


class StowTarget(_Target):
    """A DICOMweb server that receives the result objects by STOW-RS."""

    kind: Literal["dicomweb"]
    url: AnyHttpUrl
    authorization_file: Path | None = None
    ca_file: Path | None = None
    allow_insecure: bool = False
    """Whether the sender may send the header Authorization without TLS over a network."""


class WebhookTarget(_Target):
    """A program that receives a signed message when a job has ended."""

    kind: Literal["webhook"]
    url: AnyHttpUrl
    secret_file: Path
    ca_file: Path | None = None
    job_ends: tuple[JobEnd, ...] = ("succeeded", "failed")


Target = CStoreTarget | StowTarget | WebhookTarget

_TARGET: TypeAdapter[Target] = TypeAdapter(Annotated[Target, Field(discriminator="kind")])


def read_targets() -> tuple[Target, ...]:
    """Return the targets of the configuration file.

    Raises
    ------
    Problem
        422 ``invalid_configuration``.
    """
    return tuple(read_table("targets", _TARGET).values())
