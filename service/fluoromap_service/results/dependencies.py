"""Everything that a kept picture, mesh or report depends on, in one place.

The store keeps a file under the hash of these values and makes a new one when a value changes. Each list begins with the
version of the code that makes the file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from fluoromap import drawing, meshes
from fluoromap.drawing.overlay import Look
from fluoromap.geometry import Camera
from fluoromap_service.results.fusion import Fusion
from fluoromap_service.results.origins import Origin

Dependencies = dict[str, Any]
"""JSON values."""

_BY_HASH = frozenset({"facts", "chamber", "covariances_mm2", "electrodes_uv"})
"""Fields of a fusion that other dependencies replace.

The hash of the run's file replaces ``facts``, and the hash of the map replaces ``chamber``. The look says whether a picture
shows ``covariances_mm2``, which are the same in all pictures of a job, and ``electrodes_uv``, which it contains.
"""


def overlay_dependencies(fusion: Fusion, look: Look, *, moving: bool) -> Dependencies:
    """Return the dependencies of an overlay (PNG), or of its propagation (GIF).

    Every field of the fusion and of the look counts, so that a new field cannot be forgotten.
    """
    return {
        "kind": "propagation" if moving else "overlay",
        "drawing": drawing.VERSION,
        "fusion": _fields(fusion, _BY_HASH),
        "look": _fields(look),
    }


def mesh_dependencies(map_sha256: str, mesh_format: str, origin: Origin) -> Dependencies:
    """Return the dependencies of a mesh file; its colours come from the drawing code."""
    return {
        "kind": "mesh",
        "meshes": meshes.VERSION,
        "drawing": drawing.VERSION,
        "map": map_sha256,
        "format": str(mesh_format),
        "origin": str(origin),
    }


def map_picture_dependencies(map_sha256: str, *, simulated: bool) -> Dependencies:
    """Return the dependencies of the picture of the map from six sides."""
    return {"kind": "map_picture", "drawing": drawing.VERSION, "map": map_sha256, "simulated": simulated}


def result_object_dependencies(job_id: str, name: str) -> Dependencies:
    """Return the dependencies of a DICOM object of a job.

    The zip of all objects has a name too. Only the job counts: a later version of the service may draw other pictures, but
    an object never changes under its UID.
    """
    return {"kind": "dicom", "job_id": job_id, "name": name}


def report_dependencies(
    template_sha256: str, job_id: str, job_version: int, label: str | None, guessed_sites: tuple[str, ...]
) -> Dependencies:
    """Return the dependencies of a job's report, which prints the version of the package."""
    return {
        "kind": "report",
        "job_id": job_id,
        "package": version("fluoromap"),
        "drawing": drawing.VERSION,
        "template": template_sha256,
        "job": job_version,
        "label": label,
        "guessed_sites": list(guessed_sites),
    }


def tracks_table_dependencies(job_id: str, job_version: int) -> Dependencies:
    """Return the dependencies of the table of an ended job's tracks."""
    return {
        "kind": "tracks_table",
        "job_id": job_id,
        "package": version("fluoromap"),
        "job": job_version,
    }


def _fields(value: Any, without: Collection[str] = ()) -> dict[str, Any]:
    return {
        field.name: _json(getattr(value, field.name))
        for field in dataclasses.fields(value)
        if field.name not in without
    }


def _json(value: Any) -> Any:
    if isinstance(value, Camera):
        return [value.matrix.tolist(), value.rows, value.columns]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_json(item) for item in value]
    if dataclasses.is_dataclass(value):
        return _fields(value)
    return value
