"""All tables of single-view tracking."""

from __future__ import annotations

from dataclasses import dataclass

from fluoromap.contracts import Context
from fluoromap.paper.tables.phantom_runs import PhantomRun, phantom_runs
from fluoromap.paper.tables.rigid_helix import RigidPoseRow, rigid_pose_rows
from fluoromap.paper.tables.table1 import Table1Row, table1
from fluoromap.paper.tables.table2 import RigidPhantomRow, Table2Row, rigid_phantom_rows, table2
from fluoromap.paper.tables.whole_cycle import Scenario, WholeCycleRow, whole_cycle_rows
from fluoromap.registry import plugins

HEARTS = (9401, 9402, 9403, 9404)
"""Seeds of the simulated hearts; no solver was tuned on them."""
SITES = 20
"""Mapping sites of a heart, as in the paper."""
TRACKED_SITES = 4
"""Sites of a heart that are tracked over the whole cycle; the others contribute their cycles."""
BREATHING_MM = 4.0


@dataclass(frozen=True, slots=True)
class OneViewTables:
    """The paper's two tables, and the same simulated data through the other solvers.

    motion_prior : empty where that solver does not load.
    """

    table1: tuple[Table1Row, ...]
    rigid_pose: tuple[RigidPoseRow, ...]
    table2: tuple[Table2Row, ...]
    rigid_pose_phantom: tuple[RigidPhantomRow, ...]
    motion_prior: tuple[WholeCycleRow, ...]


def one_view_tables(
    context: Context, hearts: tuple[int, ...] = HEARTS, sites: int = SITES, tracked_sites: int = TRACKED_SITES
) -> OneViewTables:
    """Make all tables; the same arguments give the same figures.

    Parameters
    ----------
    hearts : tuple of int
        Seeds of the simulated hearts of Table 2 and of the whole cycle.
    sites, tracked_sites : int
        Sites of each heart, and the number of them that are tracked over the whole cycle.
    """
    helices = table1()
    context.progress(0.05)
    rigid = tuple(rigid_pose_rows())
    context.progress(0.25)
    held: list[PhantomRun] = []
    breathing: list[PhantomRun] = []
    for number, heart in enumerate(hearts, start=1):
        held += phantom_runs(heart, sites, sites, 0.0)
        breathing += phantom_runs(heart, sites, tracked_sites, BREATHING_MM)
        context.progress(0.25 + 0.25 * number / len(hearts))
    hearts_moved = table2(held)
    context.progress(0.6)
    one_body = rigid_phantom_rows(_first_sites(held, tracked_sites))
    context.progress(0.65)
    tracked_held = _first_sites(held, tracked_sites)
    scenarios: tuple[tuple[Scenario, list[PhantomRun]], ...] = (
        ("breath held, own cycle", tracked_held),
        ("breathing, own cycle", breathing),
        ("breath held, cycles of other sites", [run.without_own_cycle(tuple(held)) for run in tracked_held]),
    )
    cycles: list[WholeCycleRow] = []
    for number, (scenario, runs) in enumerate(scenarios if _installed("motion-prior") else ()):
        for part, rows in enumerate(whole_cycle_rows(scenario, runs)):
            cycles += rows
            context.progress(0.65 + 0.35 * (2 * number + part + 1) / (2 * len(scenarios)))
    context.progress(1.0)
    return OneViewTables(helices, rigid, hearts_moved, one_body, tuple(cycles))


def _installed(solver: str) -> bool:
    """Return True where a solver loads; the other tables must work without it."""
    return any((row.kind, row.name) == ("monoplane", solver) and row.error is None for row in plugins())


def _first_sites(runs: list[PhantomRun], count: int) -> list[PhantomRun]:
    """Return the runs of the first sites of each heart."""
    first: dict[int, list[str]] = {}
    for run in runs:
        names = first.setdefault(run.heart, [])
        if run.solver_input.site not in names and len(names) < count:
            names.append(run.solver_input.site)
    return [run for run in runs if run.solver_input.site in first[run.heart]]
