"""The targets of deliveries, from a TOML file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AnyHttpUrl, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from fluoromap_service.problem import Problem

JobEnd = Literal["succeeded", "failed", "cancelled"]


class _Target(BaseModel):
    """The members that all kinds of targets have."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    first_wait_seconds: float = Field(30.0, gt=0)
    longest_wait_seconds: float = Field(3600.0, gt=0)
    give_up_days: float = Field(7.0, gt=0)
    timeout_seconds: float = Field(120.0, gt=0)

    def wait_seconds(self, failures: int) -> float:
        """Return the wait after so many failures in a row; each doubles it."""
        return float(min(self.first_wait_seconds * 2.0 ** min(failures - 1, 60), self.longest_wait_seconds))


class CStoreTarget(_Target):
    """A DICOM node that receives the result objects by C-STORE."""

    kind: Literal["c-store"]
    host: str = Field(min_length=1)
    port: int = Field(ge=1, le=65535)
    called_aet: str = Field(pattern=r"^[!-\[\]-~]{1,16}$")
    calling_aet: str | None = Field(None, pattern=r"^[!-\[\]-~]{1,16}$")
    tls: bool = False
    ca_file: Path | None = None
    certificate_file: Path | None = None
    key_file: Path | None = None

    @property
    def job_ends(self) -> tuple[JobEnd, ...]:
        """The ends of jobs that this target is sent."""
        return ("succeeded",)


class StowTarget(_Target):
    """A DICOMweb server that receives the result objects by STOW-RS."""

    kind: Literal["stow-rs"]
    url: AnyHttpUrl
    authorization_file: Path | None = None
    ca_file: Path | None = None

    @property
    def job_ends(self) -> tuple[JobEnd, ...]:
        """The ends of jobs that this target is sent."""
        return ("succeeded",)


class WebhookTarget(_Target):
    """A program that receives a signed message when a job has ended."""

    kind: Literal["webhook"]
    url: AnyHttpUrl
    secret_file: Path
    ca_file: Path | None = None
    job_ends: tuple[JobEnd, ...] = ("succeeded", "failed")


Target = CStoreTarget | StowTarget | WebhookTarget

_TARGETS = TypeAdapter(list[Annotated[Target, Field(discriminator="kind")]])


def read_targets(path: Path) -> tuple[Target, ...]:
    """Read the targets of a file.

    Raises
    ------
    Problem
        422 ``invalid_configuration`` when the file is no such file; its sentence names the place.
    OSError
        When the file cannot be read.
    """
    try:
        content = tomllib.loads(path.read_text())
        targets = tuple(_TARGETS.validate_python(content.pop("target", [])))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise _wrong(path, str(error)) from None
    except ValidationError as error:
        places = [
            f"target {'.'.join(str(part) for part in item['loc']) or '?'}: {item['msg']}" for item in error.errors()
        ]
        raise _wrong(path, "; ".join(places)) from None
    if content:
        raise _wrong(path, f"unknown tables: {', '.join(sorted(content))}")
    names = [target.name for target in targets]
    if len(set(names)) < len(names):
        raise _wrong(path, "two targets have the same name")
    if not names:
        raise _wrong(path, "it has no table [[target]]")
    return targets


def _wrong(path: Path, reason: str) -> Problem:
    return Problem(
        422, "invalid_configuration", f"The file {path.name} cannot be used ({reason}); correct it and start again."
    )
