"""The tables of one view for a reader: on the terminal, as JSON, as CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from fluoromap.paper.tables import DepthFigures, OneViewTables

_FIGURES = ("mean_mm", "min_mm", "max_mm", "rms_mm")
_TABLES = {
    "table1": "Table 1: moving helices, simulated, without noise; the paper's method for each start value dz",
    "table2": "Table 2: hearts, simulated, in the paper's design; the paper's method for each start value dz",
    "rigid_pose": "The helices, simulated, as one rigid body (rigid-pose)",
    "rigid_pose_phantom": "The hearts, simulated, as one rigid body (rigid-pose)",
    "motion_prior": "The hearts, simulated, over 15 images, about one cardiac cycle",
}
_UNKNOWN_TABLE_2 = (
    "The paper's figures of Table 2 are not known here (null), apart from its ratio of 3D RMS to mean at dz = 5 mm."
)
_FITTED = (
    "Fitted: the helix's depth in images 2 to 6 is shifted by amounts that were fitted to the paper's lateral figures; "
    "that predicts nothing."
)


class Bar:
    """A stage's :class:`~fluoromap.contracts.Context` that moves a progress bar and never stops."""

    def __init__(self, move: Callable[[float], None]) -> None:
        self._move = move

    def progress(self, fraction: float) -> None:
        self._move(fraction)

    def check(self) -> None:
        pass


def as_json(tables: OneViewTables) -> str:
    """One object with a list a table; what the paper does not tell is null."""
    content = {"simulated": True, "notes": [_UNKNOWN_TABLE_2, _FITTED], **asdict(tables)}
    return json.dumps(content, indent=2, allow_nan=False)


def as_csv(tables: OneViewTables) -> str:
    """A line a figure set: rows of all tables with their keys, ``source`` telling paper, ours and fitted apart."""
    lines = [line for name in _TABLES for row in getattr(tables, name) for line in _lines(name, asdict(row))]
    columns = list(dict.fromkeys(column for line in lines for column in line))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()


def _lines(table: str, row: dict[str, Any]) -> Iterator[dict[str, Any]]:
    keys = {"table": table, **{name: value for name, value in row.items() if name not in ("paper", "ours", "fitted")}}
    if "ours" not in row:
        yield {**keys, "source": "ours"}
        return
    for source in ("paper", "ours", "fitted"):
        if row.get(source) is not None:
            yield {**keys, "source": source, **row[source]}


def show(tables: OneViewTables, console: Console) -> None:
    """Print all tables."""
    _show_table_1(tables, console)
    _show_table_2(tables, console)
    _show_rigid(tables, console)
    _show_cycle(tables, console)
    console.print("All data are simulated. What the tables mean: docs/one-view.md.")


def _show_table_1(tables: OneViewTables, console: Console) -> None:
    for view in ("LAT", "AP"):
        rows = [row for row in tables.table1 if row.view == view]
        shown = Table(title=f"{_TABLES['table1']}; {view}, mm (mean min max RMS)", title_justify="left")
        for column in ("dz", "images", "paper", "H77", "H18"):
            shown.add_column(column, justify="right")
        if view == "LAT":
            shown.add_column("H77 fitted", justify="right")
        for row in rows:
            if row.helix != "H77":
                continue
            small = next(
                other for other in rows if (other.helix, other.dz_mm, other.images) == ("H18", row.dz_mm, row.images)
            )
            cells = [str(row.dz_mm), str(row.images), _four(row.paper), _four(row.ours), _four(small.ours)]
            shown.add_row(*cells, *([_four(row.fitted)] if view == "LAT" else []), end_section=row.images == 6)
        console.print(shown)
        off = [abs(row.ours.rms_mm - row.paper.rms_mm) / row.paper.rms_mm for row in rows if row.helix == "H77"]
        console.print(f"{view}: the 3D RMS of H77 differs from the paper's by {sum(off) / len(off):.1%} on average.")
        fitted = [
            abs(row.fitted.rms_mm - row.paper.rms_mm) / row.paper.rms_mm for row in rows if row.fitted is not None
        ]
        if fitted:
            console.print(f"LAT, fitted: by {sum(fitted) / len(fitted):.1%}. {_FITTED}")
        console.print()


def _show_table_2(tables: OneViewTables, console: Console) -> None:
    shown = Table(title=f"{_TABLES['table2']}, mm", title_justify="left")
    for column in ("view", "electrodes", "dz", "images", "ours: mean min max RMS", "RMS/mean", "the paper's"):
        shown.add_column(column, justify="right")
    for row in tables.table2:
        known = "" if row.paper_rms_over_mean is None else f"{row.paper_rms_over_mean:.3f}"
        shown.add_row(
            row.view, row.electrodes, str(row.dz_mm), str(row.images), _four(row.ours),
            f"{row.ours_rms_over_mean:.3f}", known, end_section=row.dz_mm == 5 and row.images == 6,
        )  # fmt: skip
    console.print(shown)
    console.print(_UNKNOWN_TABLE_2)
    console.print()


def _show_rigid(tables: OneViewTables, console: Console) -> None:
    helices = Table(title=f"{_TABLES['rigid_pose']}, mm", title_justify="left")
    for column in ("helix", "view", "noise px", "images", "3D RMS", "bound", "dz 0 or 5 changes it by"):
        helices.add_column(column, justify="right")
    for row in tables.rigid_pose:
        rms = f"{row.rms_mm:.3f}" if row.noise_px else f"{row.rms_mm:.0e}"
        helices.add_row(
            row.helix, row.view, f"{row.noise_px:.1f}", str(row.images), rms, f"{row.bound_mm:.3f}",
            f"{row.start_value_spread_mm:.0e}",
        )  # fmt: skip
    console.print(helices)
    hearts = Table(title=f"{_TABLES['rigid_pose_phantom']}, mm", title_justify="left")
    for column in ("view", "electrodes", "images", "answer", "bound of a rigid body"):
        hearts.add_column(column, justify="right")
    for one in tables.rigid_pose_phantom:
        answer = f"refused, {one.refused} of {one.runs} runs: {one.reason}" if one.refused else ""
        if one.rms_mm is not None:
            answer += f"{'; ' if answer else ''}3D RMS {one.rms_mm:.2f} in {one.runs - one.refused} of {one.runs} runs"
        hearts.add_row(one.view, one.electrodes, str(one.images), answer, f"{one.bound_mm:.1f}")
    console.print(hearts)
    example = next((one.example for one in tables.rigid_pose_phantom if one.example is not None), None)
    if example is not None:
        console.print(f"A refusal in full: {example}")
    console.print()


def _show_cycle(tables: OneViewTables, console: Console) -> None:
    if not tables.motion_prior:
        console.print("The solver motion-prior does not load; 'fluoromap plugins' tells why.")
        return
    shown = Table(title=f"{_TABLES['motion_prior']}, mm", title_justify="left")
    for column in (
        "data", "view", "electrodes", "solver", "3D RMS", "along the ray", "lateral", "to reference", "worst heart",
        "images < 2 mm",
    ):  # fmt: skip
        shown.add_column(column, justify="left" if column in ("data", "solver") else "right")
    for row in tables.motion_prior:
        figures = (row.rms_mm, row.along_ray_mm, row.lateral_mm, row.relative_rms_mm, row.largest_heart_rms_mm)
        solver = f"{row.solver} (refused {row.refused} of {row.runs})" if row.refused else row.solver
        shown.add_row(
            row.scenario, row.view, row.electrodes, solver,
            *("refused" if figure is None else f"{figure:.2f}" for figure in figures),
            f"{row.images_below_2_mm} of {row.images - 1}", end_section=row.solver == "motion-prior",
        )  # fmt: skip
    console.print(shown)
    one = tables.motion_prior[0]
    console.print(f"{one.hearts} hearts, {one.runs} runs a row, pixel noise {one.noise_px} px.")


def _four(figures: DepthFigures | None) -> str:
    return "" if figures is None else " ".join(f"{getattr(figures, name):6.3f}" for name in _FIGURES)
