"""The dependencies of kept files: whatever changes a picture changes its key."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fluoromap import drawing, meshes
from fluoromap.drawing.overlay import Look
from fluoromap.geometry import Gantry, camera_from_gantry
from fluoromap_service.results import dependencies
from fluoromap_service.results.dependencies import mesh_dependencies, overlay_dependencies, report_dependencies
from fluoromap_service.results.fusion import Fusion
from fluoromap_service.results.origins import Origin

CAMERA = camera_from_gantry(Gantry(0.0, 0.0, 1000.0, 700.0, (0.3, 0.3), 512, 512))
OTHER = camera_from_gantry(Gantry(30.0, 0.0, 1000.0, 700.0, (0.3, 0.3), 512, 512))
BY_HASH: Any = None
FUSION = Fusion(
    uid="1.2", sha256="f" * 64, facts=BY_HASH, frame=3, camera=CAMERA, map_sha256="a" * 64, chamber=BY_HASH,
    shift_mm=np.zeros(3), site="S01", tip_uv=None, covariances_mm2={}, electrodes_uv={},
)  # fmt: skip
CHANGES: dict[str, Any] = {
    "uid": "1.3", "sha256": "e" * 64, "frame": 4, "camera": OTHER, "map_sha256": "b" * 64, "shift_mm": np.ones(3),
    "site": "S02", "tip_uv": np.array([1.0, 2.0]),
}  # fmt: skip
LOOKS: dict[str, Any] = {
    "scale": 2, "palette": "red-early", "step_ms": 5.0, "covariances_mm2": {"S01": np.eye(3)}, "until_ms": 10.0,
    "electrodes_uv": {"mapping": np.ones((4, 2))}, "simulated": True,
}  # fmt: skip


def _key(value: dict[str, Any]) -> str:
    return json.dumps(value, sort_keys=True)


def test_every_part_of_an_overlay_changes_its_key() -> None:
    keys = {
        _key(overlay_dependencies(FUSION, Look(), moving=False)),
        _key(overlay_dependencies(FUSION, Look(), moving=True)),
        *(_key(overlay_dependencies(replace(FUSION, **{k: v}), Look(), moving=False)) for k, v in CHANGES.items()),
        *(_key(overlay_dependencies(FUSION, replace(Look(), **{k: v}), moving=False)) for k, v in LOOKS.items()),
    }
    assert len(keys) == 2 + len(CHANGES) + len(LOOKS)


def test_no_field_of_an_overlay_is_forgotten() -> None:
    assert {field.name for field in dataclasses.fields(Fusion)} == set(CHANGES) | dependencies._BY_HASH
    # No route sets the colour scale that the pictures of a propagation share.
    assert {field.name for field in dataclasses.fields(Look)} == set(LOOKS) | {"times"}


def test_equal_parts_give_equal_keys() -> None:
    again = replace(FUSION, shift_mm=np.zeros(3), covariances_mm2={"S01": np.eye(3)})
    assert overlay_dependencies(again, Look(), moving=False) == overlay_dependencies(FUSION, Look(), moving=False)


def test_every_part_of_a_mesh_changes_its_key() -> None:
    asked = [("a", "ply", Origin.REFERENCE), ("b", "ply", Origin.REFERENCE), ("a", "stl", Origin.REFERENCE)]
    asked.append(("a", "ply", Origin.ISOCENTRE))
    assert len({_key(mesh_dependencies(*each)) for each in asked}) == len(asked)


@pytest.mark.parametrize(("module", "kinds"), [(drawing, 3), (meshes, 1)])
def test_the_version_of_the_code_that_makes_a_file_changes_its_key(
    monkeypatch: pytest.MonkeyPatch, module: Any, kinds: int
) -> None:
    def keys() -> list[str]:
        return [
            _key(overlay_dependencies(FUSION, Look(), moving=False)),
            _key(mesh_dependencies("a", "ply", Origin.REFERENCE)),
            _key(report_dependencies("t", "j", 1, "label", ())),
        ]

    before = keys()
    monkeypatch.setattr(module, "VERSION", "next")
    assert sum(old != new for old, new in zip(before, keys(), strict=True)) == kinds
