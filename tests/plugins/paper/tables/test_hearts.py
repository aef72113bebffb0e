"""The tables of simulated hearts, on one small heart."""

import numpy as np
import pytest

from fluoromap.contracts import Context, MonoplaneView, Refusal, Track
from fluoromap.paper.tables import whole_cycle
from fluoromap.paper.tables.phantom_runs import CYCLE_IMAGES, PhantomRun, phantom_runs
from fluoromap.paper.tables.rigid_helix import RigidPoseRow, rigid_pose_rows
from fluoromap.paper.tables.table2 import rigid_phantom_rows, table2
from fluoromap.reasons import Reason


@pytest.fixture(scope="module")
def runs() -> tuple[PhantomRun, ...]:
    return phantom_runs(31, 3, 3, 0.0)


def test_a_run_starts_in_diastole_and_a_whole_cycle_follows(runs: tuple[PhantomRun, ...]) -> None:
    assert [run.view for run in runs] == ["LAT", "PA"] * 3
    for run in runs:
        assert len(run.electrodes) == 12
        cycle = run.part(CYCLE_IMAGES)
        assert len(cycle.truth_mm) == CYCLE_IMAGES
        phases = np.array([observation.phase for observation in cycle.solver_input.observations])
        assert phases[0] == pytest.approx(0.8, abs=0.05)
        # A dog's heart at 30 images a second: 13.6 to 18.8 of them a cycle.
        steps = np.diff(phases) % 1.0
        assert steps == pytest.approx(steps[0])
        assert 1 / 18.8 <= steps[0] <= 1 / 13.6


def test_a_solver_gets_the_projected_truth(runs: tuple[PhantomRun, ...]) -> None:
    for run in runs:
        by_label = {label: run.truth_mm[:, row] for row, label in enumerate(run.electrodes)}
        for observation in run.solver_input.observations[:5]:
            for chain in observation.chains:
                truth = np.array([by_label[chain.catheter, number][observation.frame] for number in chain.electrodes])
                off = run.solver_input.camera.project(truth) - chain.pixels_uv
                assert np.abs(off).max() < 5 * 0.5


def test_without_its_own_cycle_a_site_gets_those_of_the_others(runs: tuple[PhantomRun, ...]) -> None:
    bare = runs[0].without_own_cycle(runs)
    assert bare.solver_input.cycle is None
    assert len(bare.solver_input.others) == 2
    assert all(cycle is not runs[0].solver_input.cycle for cycle in bare.solver_input.others)


def test_table_2_prints_the_distance_of_the_start_from_the_truth(runs: tuple[PhantomRun, ...]) -> None:
    rows = table2(runs)
    assert len(rows) == 2 * 2 * 6 * 2
    assert len({(row.view, row.electrodes, row.dz_mm, row.images) for row in rows}) == len(rows)
    for row in rows:
        assert row.paper is None
        assert (row.paper_rms_over_mean is not None) == (row.electrodes == "12" and row.dz_mm == 5)
        if row.dz_mm == 5:
            # The heart hardly moves in these images: the start value comes out and adds up.
            assert row.ours.mean_mm == pytest.approx(5, abs=0.7)
            expected = np.sqrt(np.mean(np.arange(1, row.images) ** 2))
            assert row.ours_rms_over_mean == pytest.approx(expected, rel=0.06)


def test_a_mapping_catheter_alone_is_refused_as_a_rigid_body(runs: tuple[PhantomRun, ...]) -> None:
    rows = rigid_phantom_rows(runs)
    assert len(rows) == 2 * 2 * 3
    for row in rows:
        assert (row.rms_mm is None) == (row.refused == row.runs)
        if row.electrodes == "mapping":
            assert row.refused == row.runs
            assert row.reason == "depth_unobservable"
            assert row.bound_mm > 10


def test_rigid_helices_need_no_start_value() -> None:
    rows: list[RigidPoseRow] = list(rigid_pose_rows())
    for row in rows:
        if row.noise_px == 0:
            assert row.rms_mm <= 1e-8
            assert row.start_value_spread_mm <= 1e-8
        else:
            assert row.rms_mm == pytest.approx(row.bound_mm, rel=0.35)
            assert row.start_value_spread_mm <= 1e-5


def test_errors_are_split_along_and_across_the_ray(
    runs: tuple[PhantomRun, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = {(run.solver_input.site, run.solver_input.view): run.part(CYCLE_IMAGES) for run in runs}

    class TooFar:
        """A solver whose positions are 1 mm behind the truth."""

        def track(self, view: MonoplaneView, context: Context) -> Track:
            run = parts[view.site, view.view]
            rays = run.truth_mm - view.camera.source_world_mm
            along = rays / np.linalg.norm(rays, axis=2, keepdims=True)
            n, m = run.truth_mm.shape[:2]
            return Track(
                run.electrodes, np.ones((n, m), bool), run.truth_mm + along, run.truth_mm, np.zeros((n, m, 3, 3)),
                np.zeros((n, m, 2)), ((),) * m,
            )  # fmt: skip

    monkeypatch.setattr(whole_cycle, "build_monoplane", lambda name, params: TooFar())
    rows = [row for part in whole_cycle.whole_cycle_rows("breath held, own cycle", runs) for row in part]
    assert len(rows) == 2 * 2 * 3
    for row in rows:
        if row.solver == "motion-prior baseline":
            assert row.rms_mm == pytest.approx(0, abs=1e-9)
        else:
            assert (row.rms_mm, row.along_ray_mm) == pytest.approx((1, 1))
            assert row.lateral_mm == pytest.approx(0, abs=1e-6)
            assert row.relative_rms_mm < 0.1
            assert row.images_below_2_mm == 14


def test_refused_runs_are_counted_and_give_no_figures(
    runs: tuple[PhantomRun, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Refuses:
        def track(self, view: MonoplaneView, context: Context) -> Track:
            raise Refusal(Reason.VIEW_MIRRORED)

    monkeypatch.setattr(whole_cycle, "build_monoplane", lambda name, params: Refuses())
    for rows in whole_cycle.whole_cycle_rows("breathing, own cycle", runs):
        for row in rows:
            assert row.refused == row.runs == 3
            assert (row.rms_mm, row.largest_heart_rms_mm, row.images_below_2_mm) == (None, None, 0)
