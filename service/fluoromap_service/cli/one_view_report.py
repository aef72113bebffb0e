"""The tables about the depth in a single view, for the terminal, as JSON and as CSV."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
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
_UNKNOWN_TABLE_2 = "The paper's figures of Table 2 are unknown (null), except its ratio of 3D RMS to mean at dz = 5 mm."
_FITTED = (
    "Fitted: the depth of the helix in images 2 to 6 is shifted by amounts that were fitted to the paper's lateral figures. "
    "This is no prediction."
)


def as_json(tables: OneViewTables) -> str:
    """Return one JSON object with a list for each table.

    Values that the paper omits are null.
    """
    content = {"simulated": True, "notes": [_UNKNOWN_TABLE_2, _FITTED], **asdict(tables)}
    return json.dumps(content, indent=2, allow_nan=False)


def as_csv(tables: OneViewTables) -> str:
    """Return the rows of all tables as CSV.

    The column ``source`` is paper, ours or fitted.
    """
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
    console.print("All data are simulated. The tables are explained in docs/one-view.md.")


def _show_table_1(tables: OneViewTables, console: Console) -> None:
    for view in ("LAT", "AP"):
        rows = [row for row in tables.table1 if row.view == view]
        table = Table(title=f"{_TABLES['table1']}; {view}, mm (mean min max RMS)", title_justify="left")
        for column in ("dz", "images", "paper", "H77", "H18"):
            table.add_column(column, justify="right")
        if view == "LAT":
            table.add_column("H77 fitted", justify="right")
        for row in rows:
            if row.helix != "H77":
                continue
            small = next(
                other for other in rows if (other.helix, other.dz_mm, other.images) == ("H18", row.dz_mm, row.images)
            )
            cells = [str(row.dz_mm), str(row.images), _four(row.paper), _four(row.ours), _four(small.ours)]
            table.add_row(*cells, *([_four(row.fitted)] if view == "LAT" else []), end_section=row.images == 6)
        console.print(table)
        ours = [_difference(row.ours, row.paper) for row in rows if row.helix == "H77"]
        console.print(f"{view}: the 3D RMS of H77 differs from the paper's by {sum(ours) / len(ours):.1%} on average.")
        fitted = [_difference(row.fitted, row.paper) for row in rows if row.fitted is not None]
        if fitted:
            console.print(f"LAT, fitted: by {sum(fitted) / len(fitted):.1%}. {_FITTED}")
        console.print()


def _show_table_2(tables: OneViewTables, console: Console) -> None:
    table = Table(title=f"{_TABLES['table2']}, mm", title_justify="left")
    for column in ("view", "electrodes", "dz", "images", "ours: mean min max RMS", "RMS/mean", "the paper's"):
        table.add_column(column, justify="right")
    for row in tables.table2:
        known = "" if row.paper_rms_over_mean is None else f"{row.paper_rms_over_mean:.3f}"
        table.add_row(
            row.view, row.electrodes, str(row.dz_mm), str(row.images), _four(row.ours),
            f"{row.ours_rms_over_mean:.3f}", known, end_section=row.dz_mm == 5 and row.images == 6,
        )  # fmt: skip
    console.print(table)
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
    for heart in tables.rigid_pose_phantom:
        answer = f"refused, {heart.refused} of {heart.runs} runs: {heart.reason}" if heart.refused else ""
        if heart.rms_mm is not None:
            solved = heart.runs - heart.refused
            answer += f"{'; ' if answer else ''}3D RMS {heart.rms_mm:.2f} in {solved} of {heart.runs} runs"
        hearts.add_row(heart.view, heart.electrodes, str(heart.images), answer, f"{heart.bound_mm:.1f}")
    console.print(hearts)
    example = next((heart.example for heart in tables.rigid_pose_phantom if heart.example is not None), None)
    if example is not None:
        console.print(f"A refusal in full: {example}")
    console.print()


def _show_cycle(tables: OneViewTables, console: Console) -> None:
    if not tables.motion_prior:
        console.print("The solver motion-prior does not load; 'fluoromap plugins' shows the reason.")
        return
    table = Table(title=f"{_TABLES['motion_prior']}, mm", title_justify="left")
    for column in (
        "data", "view", "electrodes", "solver", "3D RMS", "along the ray", "lateral", "to reference", "worst heart",
        "images < 2 mm",
    ):  # fmt: skip
        table.add_column(column, justify="left" if column in ("data", "solver") else "right")
    for row in tables.motion_prior:
        figures = (row.rms_mm, row.along_ray_mm, row.lateral_mm, row.relative_rms_mm, row.largest_heart_rms_mm)
        solver = f"{row.solver} (refused {row.refused} of {row.runs})" if row.refused else row.solver
        table.add_row(
            row.scenario, row.view, row.electrodes, solver,
            *("refused" if figure is None else f"{figure:.2f}" for figure in figures),
            f"{row.images_below_2_mm} of {row.images - 1}", end_section=row.solver == "motion-prior",
        )  # fmt: skip
    console.print(table)
    first = tables.motion_prior[0]
    console.print(f"{first.hearts} hearts, {first.runs} runs for each row, pixel noise {first.noise_px} px.")


def _difference(figures: DepthFigures, paper: DepthFigures) -> float:
    """Return the difference of the 3D RMS as a fraction of the paper's."""
    return abs(figures.rms_mm - paper.rms_mm) / paper.rms_mm


def _four(figures: DepthFigures | None) -> str:
    return "" if figures is None else " ".join(f"{getattr(figures, name):6.3f}" for name in _FIGURES)
