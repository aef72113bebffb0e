"""The command ``fluoromap tables``: its formats and exit codes, on invented rows."""

from __future__ import annotations

import csv
import io
import json
import sys

import pytest
from rich.console import Console

from fluoromap.paper.tables import DepthFigures, OneViewTables, Table1Row, Table2Row
from fluoromap.paper.tables import one_view as made
from fluoromap.paper.tables.rigid_helix import RigidPoseRow
from fluoromap.paper.tables.table2 import RigidPhantomRow
from fluoromap.paper.tables.whole_cycle import WholeCycleRow
from fluoromap_service.cli import app, one_view_report
from fluoromap_service.cli.progress import BarContext

PAPER, OURS, FITTED = (DepthFigures(*(k + x for x in (0.1, 0.0, 0.2, 0.3))) for k in (1, 2, 3))
TABLES = OneViewTables(
    table1=tuple(
        Table1Row(view, helix, 5, 6, PAPER, OURS, FITTED if (view, helix) == ("LAT", "H77") else None)
        for helix in ("H77", "H18")
        for view in ("LAT", "AP")
    ),
    rigid_pose=(RigidPoseRow("H18", "LAT", 0.5, 6, 0.36, 0.37, 1e-9),),
    table2=(Table2Row("PA", "12", 5, 3, None, OURS, 1.591, 1.6),),
    rigid_pose_phantom=(
        RigidPhantomRow("LAT", "mapping", 0.5, 15, 4, 4, "depth_unobservable", "The electrodes bend.", None, 60.0),
        RigidPhantomRow("LAT", "12", 0.5, 3, 4, 1, "depth_unobservable", "The electrodes bend.", 1.25, 1.3),
    ),
    motion_prior=(
        WholeCycleRow(
            "breathing, own cycle", "PA", "12", "motion-prior", 0.5, 15, 4, 8, 0, 0.95, 0.94, 0.08, 0.4, 1.3, 14
        ),
    ),
)


def test_json_has_the_promised_shape() -> None:
    content = json.loads(one_view_report.as_json(TABLES))
    assert content["simulated"] is True
    assert {"table1", "rigid_pose", "table2", "motion_prior"} <= set(content)
    figures = {"mean_mm", "min_mm", "max_mm", "rms_mm"}
    for row in content["table1"]:
        assert {"view", "helix", "dz_mm", "images", "paper", "ours"} <= set(row)
        assert set(row["paper"]) == set(row["ours"]) == figures
    assert content["table1"][0]["paper"]["rms_mm"] == 1.3
    assert {"helix", "view", "noise_px", "images", "rms_mm", "bound_mm"} <= set(content["rigid_pose"][0])
    assert content["table2"][0]["paper"] is None
    assert content["rigid_pose_phantom"][0]["rms_mm"] is None
    assert "null" in content["notes"][0]


def test_csv_has_a_line_for_each_source() -> None:
    lines = list(csv.DictReader(io.StringIO(one_view_report.as_csv(TABLES))))
    first = [line for line in lines if (line["table"], line["view"], line["helix"]) == ("table1", "LAT", "H77")]
    assert [line["source"] for line in first] == ["paper", "ours", "fitted"]
    assert float(first[1]["rms_mm"]) == 2.3
    refused = next(line for line in lines if line["table"] == "rigid_pose_phantom" and line["electrodes"] == "mapping")
    assert (refused["rms_mm"], refused["reason"]) == ("", "depth_unobservable")


def test_terminal_calls_refusals_and_simulations_by_their_names() -> None:
    text = io.StringIO()
    one_view_report.show(TABLES, Console(file=text, width=200))
    shown = text.getvalue()
    assert shown.count("simulated") >= 6
    assert "refused, 4 of 4 runs: depth_unobservable" in shown
    assert "refused, 1 of 4 runs: depth_unobservable; 3D RMS 1.25 in 3 of 4 runs" in shown
    assert "H77 fitted" in shown


def _call(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int | str | None:
    monkeypatch.setattr(sys, "argv", ["fluoromap", "tables", *arguments])
    with pytest.raises(SystemExit) as end:
        app.main()
    return end.value.code


@pytest.mark.parametrize("option", ["--json", "--csv", ""])
def test_figures_go_to_output_and_progress_to_the_other_stream(
    option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "fluoromap_service.cli.commands.tables.one_view_tables", lambda context: (context.progress(1.0), TABLES)[1]
    )
    assert _call(monkeypatch, *([option] if option else [])) in (None, 0)
    written = capsys.readouterr()
    assert "simulate, follow" in written.err
    assert "simulate, follow" not in written.out
    if option == "--json":
        assert json.loads(written.out)["table1"]


@pytest.mark.parametrize("arguments", [("--json", "--csv"), ("--xml",), ("more",)])
def test_wrong_usage_ends_with_2(arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    assert _call(monkeypatch, *arguments) == 2


def test_all_tables_come_about(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real computation, on few hearts and without the slowest solver, which has tests of its own."""
    monkeypatch.setattr(made, "whole_cycle_rows", lambda scenario, runs: iter(()))
    monkeypatch.setattr(made, "rigid_pose_rows", lambda: iter(()))
    reported: list[float] = []
    tables = made.one_view_tables(BarContext(reported.append), hearts=(7,), sites=2, tracked_sites=1)
    assert len(tables.table1) == 96
    assert len(tables.table2) == 48
    assert {row.runs for row in tables.rigid_pose_phantom} == {1}
    assert reported == sorted(reported)
    json.loads(one_view_report.as_json(tables))
