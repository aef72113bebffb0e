"""The file ``study.toml`` of a folder: catheters, default geometry, the runs of sites, plugins."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.registry import DEFAULTS, UnknownPlugin, plugin
from fluoromap_service.api.study.catheters import CatheterIn, Line
from fluoromap_service.api.study.csv_input import LARGEST_LAT_MS
from fluoromap_service.api.study.gantry import GantryPatch
from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.problem import Problem
from fluoromap_service.store.names import normal_name
from fluoromap_service.study.catheters import catalogue_with_roles
from fluoromap_service.study.freeze import PipelineRequest
from fluoromap_service.study.sites import is_site_name

NAME = "study.toml"
"""Name of the file in its folder."""

Mistake = tuple[str, str]
"""The key, for example ``sites.S01.lat_ms``, and what is wrong with it."""


class SiteEntry(BaseModel):
    """The runs and the activation time of one site; a file is named as in the folder."""

    model_config = ConfigDict(extra="forbid")
    view_a: str | None = None
    view_b: str | None = None
    lat_ms: float | None = Field(None, ge=-LARGEST_LAT_MS, le=LARGEST_LAT_MS, allow_inf_nan=False)

    @property
    def files(self) -> dict[str, str]:
        """The named files, view -> file."""
        return {view: file for view, file in (("view_a", self.view_a), ("view_b", self.view_b)) if file is not None}


class StudyFile(BaseModel):
    """The content of ``study.toml``; every key is optional."""

    model_config = ConfigDict(extra="forbid")
    catheters: list[CatheterIn] | None = Field(None, max_length=32)
    reference: Line | None = Field(None, max_length=64)
    gantry: GantryPatch = GantryPatch()
    sites: dict[str, SiteEntry] = {}
    pipeline: PipelineRequest = PipelineRequest()

    @property
    def study(self) -> dict[str, Any]:
        """The catheters and the reference as ``POST /v1/studies`` takes them."""
        return self.model_dump(mode="json", include={"catheters", "reference"}, exclude_unset=True)

    @property
    def job(self) -> dict[str, Any]:
        """The plugins as ``POST /v1/studies/{id}/jobs`` takes them."""
        return self.model_dump(mode="json", include={"pipeline"}, exclude_unset=True)

    @property
    def default_gantry(self) -> dict[str, Any]:
        """The geometry of runs whose header lacks it, as ``PATCH`` of the study takes it."""
        return self.gantry.model_dump(mode="json", exclude_none=True)


def read_study_file(path: Path) -> StudyFile:
    """Read and check a ``study.toml``.

    Raises
    ------
    CommandFailed
        With each wrong key or value and the allowed ones.
    """
    try:
        content = tomllib.loads(normal_name(path.read_text(encoding="utf-8-sig")))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CommandFailed(f"{path} is not a TOML file in UTF-8: {error}; correct the file.") from None
    try:
        # In JSON's strict mode an integer is a number, an array is a tuple, and neither a truth value nor a text is a number.
        study = StudyFile.model_validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        raise _wrong(path, mistakes_of(error, StudyFile)) from None
    mistakes = [*_wrong_catheters(study), *_wrong_sites(study), *_wrong_plugins(study.pipeline)]
    if mistakes:
        raise _wrong(path, mistakes)
    return study


def _wrong(path: Path, mistakes: Sequence[Mistake]) -> CommandFailed:
    places = "; ".join(f"{key}: {message}" for key, message in mistakes)
    return CommandFailed(f"{path} has wrong keys or values: {places}. Correct the file.")


def mistakes_of(error: ValidationError, model: type[BaseModel], prefix: tuple[str, ...] = ()) -> list[Mistake]:
    """Return the keys that a model refused, with the allowed keys or values."""
    schema = model.model_json_schema()
    found = []
    for part in error.errors(include_url=False):
        place = tuple(part["loc"])
        message = part["msg"].removeprefix("Value error, ")
        if part["type"] == "extra_forbidden":
            message = f"there is no such key; allowed are {', '.join(_keys(schema, place[:-1])) or 'none'}"
        keys = [f"number {key + 1}" if isinstance(key, int) else key for key in place]
        found.append((".".join([*prefix, *keys]), message))
    return found


def _keys(schema: dict[str, Any], place: tuple[int | str, ...]) -> list[str]:
    """Return the keys that a JSON schema allows at a place of the document."""

    def resolved(node: dict[str, Any]) -> dict[str, Any]:
        for option in node.get("anyOf", []):
            if option.get("type") != "null":
                return resolved(option)
        if "$ref" in node:
            return resolved(schema["$defs"][node["$ref"].rsplit("/", 1)[-1]])
        return node

    node = resolved(schema)
    for key in place:
        inner = node.get("items") if isinstance(key, int) else node.get("properties", {}).get(key)
        node = resolved(inner or node.get("additionalProperties") or {})
    return list(node.get("properties", {}))


def _wrong_catheters(study: StudyFile) -> list[Mistake]:
    catheters = tuple(entry.catheter() for entry in study.catheters or ()) or DEFAULT_CATALOGUE.catheters
    try:
        catalogue_with_roles(catheters, study.reference)
    except Problem as problem:
        names = ", ".join(catheter.name for catheter in catheters)
        return [(where, f"{message}; the catheters are {names}") for where, message in problem.errors]
    return []


def _wrong_sites(study: StudyFile) -> list[Mistake]:
    names = [
        (f"sites.{name}", "not usable as a site's name; allowed are 1 to 64 characters without a slash")
        for name in study.sites
        if not is_site_name(name)
    ]
    return names + [
        (f"sites.{name}", "says nothing; give view_a, view_b or lat_ms")
        for name, entry in study.sites.items()
        if entry == SiteEntry()
    ]


def _wrong_plugins(pipeline: PipelineRequest) -> list[Mistake]:
    mistakes: list[Mistake] = []
    for kind, default in DEFAULTS.items():
        chosen = getattr(pipeline, kind)
        try:
            stage = plugin(kind, chosen.name or default).stage
        except UnknownPlugin as error:
            mistakes.append((f"pipeline.{kind}.name", str(error).replace("/v1/plugins", "`fluoromap plugins`")))
            continue
        assert stage is not None
        try:
            stage.Params.model_validate(chosen.params)
        except ValidationError as error:
            mistakes += mistakes_of(error, stage.Params, ("pipeline", kind, "params"))
    return mistakes
