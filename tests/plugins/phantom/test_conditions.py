"""Studies under drawn conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.phantom.clinical_study import described_catalogue, simulate_conditions
from fluoromap.phantom.conditions import (
    LARGEST_ANGLE_DEG,
    LARGEST_OFFSET_MM,
    PROPERTIES,
    Conditions,
    TableMove,
)


def test_the_same_seed_gives_the_same_study() -> None:
    first, second = (simulate_conditions(Conditions.draw(3)) for _ in range(2))
    assert first.conditions == second.conditions
    for one, other in zip(first.runs, second.runs, strict=True):
        a, b = (run.segmentation_b for run in (one, other))
        assert a is not None
        assert b is not None
        for x, y in zip(a.frames[0].chains, b.frames[0].chains, strict=True):
            assert (x.pixels_uv == y.pixels_uv).all()


def test_every_property_stays_within_its_distribution() -> None:
    drawn = [Conditions.draw(seed) for seed in range(300)]
    assert {one.rhythm for one in drawn} == {"regular", "irregular", "fibrillation"}
    assert {one.frame_rate_hz for one in drawn} == {7.5, 10.0, 15.0, 30.0, 60.0}
    assert all(0.7 <= one.seconds <= 6 and 0 <= one.breathing_mm <= 8 for one in drawn)
    errors = [error for one in drawn for error in one.gantry_errors]
    assert max(np.linalg.norm(error.rotation_deg) for error in errors) <= LARGEST_ANGLE_DEG + 1e-9
    assert max(np.linalg.norm(error.offset_mm) for error in errors) <= LARGEST_OFFSET_MM + 1e-9
    assert all(0.1 <= abs(offset) <= 0.3 for one in drawn for offset in one.tip_offsets_mm)
    assert 0.2 < np.mean([one.table is not None for one in drawn]) < 0.45
    assert 0.2 < np.mean([one.decapolar for one in drawn]) < 0.45


@pytest.mark.parametrize("name", PROPERTIES)
def test_one_property_alone_changes_nothing_else(name: str) -> None:
    calm, changed = Conditions.draw(5, ()), Conditions.draw(5, (name,))
    assert changed != calm or name == "gantry"
    assert changed.sites == calm.sites
    assert name == "breathing" or changed.breathing_mm == calm.breathing_mm
    assert name == "rhythm" or changed.rhythm == calm.rhythm


def test_a_bent_catheter_keeps_its_arc_and_shortens_its_chords() -> None:
    calm = Conditions.draw(8, ())
    bent = replace(calm, bends_deg=(0.0, 90.0, 0.0))
    straight, curved = (simulate_conditions(one).truth[0].diastole_mm["pacing"] for one in (calm, bent))
    gaps = np.linalg.norm(np.diff(straight, axis=0), axis=1), np.linalg.norm(np.diff(curved, axis=0), axis=1)
    assert gaps[0] == pytest.approx(DEFAULT_CATALOGUE["pacing"].spacing_mm, abs=0.05)
    assert 0.05 < (gaps[0] - gaps[1]).max() < 1.5


def test_a_wrong_catalogue_is_wrong_by_what_was_drawn() -> None:
    conditions = replace(Conditions.draw(1, ()), catalogue_errors_mm=((0.5, 0, 0), (0, 0, 0), (0, -0.3, 0)))
    described = described_catalogue(conditions)
    assert described["reference"].spacing_mm == (4.0, 6.0, 3.0)
    assert described["mapping"].spacing_mm == pytest.approx((4.65, 6.0, 3.3))


@pytest.mark.parametrize("in_header", [True, False])
def test_a_moved_table_moves_the_patient_and_the_header_may_say_so(in_header: bool) -> None:
    moved = TableMove(1, (10.0, 0.0, 0.0), in_header)
    calm = Conditions.draw(2, ())
    still, shifted = simulate_conditions(calm), simulate_conditions(replace(calm, table=moved))
    first, second = (study.truth[1].runs[1].pixels_uv["mapping"] for study in (still, shifted))
    assert (second - first)[..., 0].mean() == pytest.approx(10 * 5.75, rel=0.1)
    header = shifted.runs[1].camera_b
    apart = header.project(shifted.truth[1].diastole_mm["mapping"]) - second.mean(axis=0)
    assert (np.abs(apart[:, 0]).mean() < 30) == in_header
    if in_header:
        assert header.isocentre_world_mm == pytest.approx([-10, 0, 0])


def test_simultaneous_views_share_beats_and_breathing() -> None:
    study = simulate_conditions(replace(Conditions.draw(4, ()), simultaneous=True, breathing_mm=5.0))
    a, b = study.truth[0].runs
    assert (a.points_mm["mapping"] == b.points_mm["mapping"]).all()


def test_in_fibrillation_the_intervals_scatter() -> None:
    study = simulate_conditions(replace(Conditions.draw(6, ()), rhythm="fibrillation", seconds=6.0, frame_rate_hz=30.0))
    segmentation = study.runs[0].segmentation_a
    assert segmentation is not None
    intervals = np.diff(segmentation.r_wave_frames)
    assert intervals.std() / intervals.mean() > 0.08
