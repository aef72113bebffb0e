"""The registry: entry points become stages.

A plugin that fails to load is a row with its traceback; it never stops the program.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal

from pydantic import BaseModel

from fluoromap.contracts import Fuser, MonoplaneSolver, Previewer, Segmenter, Triangulator

Kind = Literal["segmenter", "triangulator", "monoplane", "fuser"]

GROUPS: dict[Kind, str] = {
    "segmenter": "fluoromap.segmenters",
    "triangulator": "fluoromap.triangulators",
    "monoplane": "fluoromap.monoplane_solvers",
    "fuser": "fluoromap.fusers",
}
_METHODS: dict[Kind, str] = {
    "segmenter": "segment",
    "triangulator": "triangulate",
    "monoplane": "track",
    "fuser": "fuse",
}
DEFAULTS: dict[Kind, str] = {
    "segmenter": "learned-chain",
    "triangulator": "maximum-likelihood",
    "monoplane": "motion-prior",
    "fuser": "smooth-surface",
}
"""The plugin of a stage for which a client names none."""


class UnknownPlugin(LookupError):
    """No plugin of that kind and name is installed, or it did not load."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """One row of the registry: a plugin class, or the traceback of its failure."""

    kind: Kind
    name: str
    version: str | None
    distribution: str | None
    stage: type[Any] | None
    error: str | None

    @property
    def default(self) -> bool:
        """Whether this plugin is used when a client names none."""
        return DEFAULTS[self.kind] == self.name

    @property
    def parameters(self) -> dict[str, Any] | None:
        """JSON schema of the plugin's parameters."""
        return None if self.stage is None else self.stage.Params.model_json_schema()


def _load(kind: Kind, entry_point: EntryPoint) -> Plugin:
    distribution = entry_point.dist.name if entry_point.dist else None
    try:
        stage = entry_point.load()
        _check(kind, entry_point.name, stage)
    except Exception:
        return Plugin(kind, entry_point.name, None, distribution, None, traceback.format_exc(limit=-3))
    return Plugin(kind, entry_point.name, stage.version, distribution, stage, None)


def _check(kind: Kind, name: str, stage: Any) -> None:
    if not isinstance(stage, type):
        raise TypeError(f"{kind} {name!r} is no class; the entry point must name a class")
    for attribute in ("name", "version", "Params", _METHODS[kind]):
        if not hasattr(stage, attribute):
            raise TypeError(f"{kind} {name!r} has no {attribute!r}")
    own_name, parameters = stage.__dict__.get("name"), getattr(stage, "Params", None)
    if own_name != name:
        raise TypeError(f"{kind} {name!r} calls itself {own_name!r}")
    if not (isinstance(parameters, type) and issubclass(parameters, BaseModel)):
        raise TypeError(f"{kind} {name!r}: Params must be a pydantic model")


def discover(kind: Kind, found: Iterable[EntryPoint]) -> tuple[Plugin, ...]:
    """Load the entry points of one kind.

    Of two plugins with the same name the first is used; the other becomes a broken row.
    """
    rows: dict[str, Plugin] = {}
    doubled: list[Plugin] = []
    for entry_point in sorted(found, key=lambda item: (item.name, item.value)):
        row = _load(kind, entry_point)
        if row.name in rows:
            message = f"another plugin named {row.name!r} was found first"
            doubled.append(Plugin(kind, row.name, row.version, row.distribution, None, message))
        else:
            rows[row.name] = row
    return (*rows.values(), *doubled)


@functools.cache
def plugins() -> tuple[Plugin, ...]:
    """Return all installed plugins of all kinds, loaded once a process."""
    return tuple(row for kind, group in GROUPS.items() for row in discover(kind, entry_points(group=group)))


def plugin(kind: Kind, name: str) -> Plugin:
    """Return the working plugin of that kind and name.

    Raises
    ------
    UnknownPlugin
        With the installed names, or the fact that this one did not load.
    """
    known = [row for row in plugins() if row.kind == kind and row.stage is not None]
    for row in known:
        if row.name == name:
            return row
    if any(row.kind == kind and row.name == name for row in plugins()):
        raise UnknownPlugin(f"the {kind} {name!r} is installed but does not load; see /v1/plugins")
    raise UnknownPlugin(f"there is no {kind} {name!r}; installed are {', '.join(row.name for row in known)}")


def build_segmenter(name: str, parameters: dict[str, Any]) -> Segmenter:
    """Return a segmenter with these parameters."""
    built: Segmenter = _build("segmenter", name, parameters)
    return built


def build_previewer() -> Previewer:
    """Return the segmenter that shows the electrodes of one frame, with its default parameters.

    A process that only shows frames does not load the other plugins: their imports take seconds.
    """
    (found,) = entry_points(group=GROUPS["segmenter"], name=DEFAULTS["segmenter"])
    built: Previewer = found.load()()
    return built


def build_triangulator(name: str, parameters: dict[str, Any]) -> Triangulator:
    """Return a triangulator with these parameters."""
    built: Triangulator = _build("triangulator", name, parameters)
    return built


def build_monoplane(name: str, parameters: dict[str, Any]) -> MonoplaneSolver:
    """Return a monoplane solver with these parameters."""
    built: MonoplaneSolver = _build("monoplane", name, parameters)
    return built


def build_fuser(name: str, parameters: dict[str, Any]) -> Fuser:
    """Return a fuser with these parameters."""
    built: Fuser = _build("fuser", name, parameters)
    return built


def _build(kind: Kind, name: str, parameters: dict[str, Any]) -> Any:
    stage = plugin(kind, name).stage
    assert stage is not None
    return stage(stage.Params.model_validate(parameters))
