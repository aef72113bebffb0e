"""A simulated study as files: complete, repeatable, and silent about the truth."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from small_runs import edited

from fluoromap.geometry import Gantry
from fluoromap.phantom import StudySpec, simulate_study
from fluoromap_service.cli.accuracy import accuracy, rms_mm
from fluoromap_service.dicom import InstanceFacts, open_frames, read_instance
from fluoromap_service.dicom.simulation import STARTED, SimulatedFiles, simulate


def _small(primary_deg: float) -> Gantry:
    return Gantry(primary_deg, 0.0, 1000.0, 500.0, (178 / 128, 178 / 128), 128, 128)


SPEC = StudySpec(seed=3, sites=2, frames=3, gantries=(_small(90.0), _small(0.0)))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimulatedFiles:
    return simulate(tmp_path_factory.mktemp("study"), SPEC, processes=1)


@pytest.mark.parametrize(
    ("attributes", "simulated"),
    [
        ({}, True),
        ({"Manufacturer": None}, False),
        ({"ManufacturerModelName": None}, False),
        # The files of results name the program as their manufacturer, and one may copy a real run with them.
        ({"ManufacturerModelName": "fluoromap"}, False),
        ({"Manufacturer": "GE MEDICAL SYSTEMS"}, False),
    ],
)
def test_only_runs_of_the_simulated_equipment_are_simulated(
    files: SimulatedFiles, tmp_path: Path, attributes: dict[str, str | None], simulated: bool
) -> None:
    path = tmp_path / "run.dcm"
    path.write_bytes(edited(files.runs[0].read_bytes(), **attributes))
    facts = read_instance(path)
    assert facts.simulated is simulated
    assert InstanceFacts.from_json(facts.to_json()) == facts
    # A run that an earlier version read is not known to be simulated.
    stored = {name: value for name, value in facts.to_json().items() if name != "simulated"}
    assert InstanceFacts.from_json(stored).simulated is False


def test_runs_are_readable_and_complete(files: SimulatedFiles) -> None:
    study = simulate_study(SPEC)
    runs = [run for site in study.sites for run in site.runs]
    facts = [read_instance(path) for path in files.runs]
    assert len({each.sop_instance_uid for each in facts}) == 4
    assert len({each.study_instance_uid for each in facts}) == 1
    for run, each in zip(runs, facts, strict=True):
        assert (each.frames, each.rows, each.columns) == (3, 128, 128)
        assert each.missing == ()
        assert each.primary_deg == run.gantry.primary_deg
        assert each.r_wave_frames == run.r_wave_frames
        assert each.acquired is not None
        assert abs(each.acquired - STARTED - timedelta(seconds=run.start_seconds)) < timedelta(milliseconds=1)


def test_files_hold_the_phantoms_pixels(files: SimulatedFiles) -> None:
    run = simulate_study(SPEC).sites[1].runs[0]
    path = files.runs[2]
    frames = open_frames(path, read_instance(path))
    assert all(np.array_equal(frames[index], run.frames[index]) for index in range(3))


def test_table_names_the_files_of_each_site(files: SimulatedFiles) -> None:
    rows = list(csv.DictReader(files.activation_times.open()))
    assert [row["site"] for row in rows] == ["S01", "S02"]
    names = [name for row in rows for name in (row["view_a"], row["view_b"])]
    assert names == [path.name for path in files.runs]


def test_truth_is_the_phantoms_and_is_apart(files: SimulatedFiles) -> None:
    truth = json.loads(files.truth.read_text())
    site = simulate_study(SPEC).sites[1]
    assert truth["sites"][1]["relative_mm"]["mapping"] == pytest.approx(site.truth.relative_mm["mapping"], abs=1e-4)
    assert np.shape(truth["sites"][0]["runs"]["b"]["points_mm"]["pacing"]) == (3, 4, 3)
    assert files.truth.parent != files.runs[0].parent
    assert all(path.suffix == ".dcm" for path in files.runs[0].parent.iterdir())


def test_same_spec_same_bytes_whatever_the_processes_and_others_differ(files: SimulatedFiles, tmp_path: Path) -> None:
    told: list[None] = []
    again = simulate(tmp_path / "again", SPEC, processes=2, on_run=lambda: told.append(None))
    assert len(told) == 4
    for first, second in zip(files.runs, again.runs, strict=True):
        assert first.read_bytes() == second.read_bytes()
    other = simulate(tmp_path / "other", replace(SPEC, seed=4, sites=1), processes=1)
    assert read_instance(other.runs[0]).sop_instance_uid != read_instance(files.runs[0]).sop_instance_uid


def test_accuracy_is_the_distance_from_the_truth(files: SimulatedFiles) -> None:
    truth = json.loads(files.truth.read_text())
    x, y, z = truth["sites"][0]["relative_mm"]["mapping"][0]
    located = {"site": "S01", "catheter": "mapping", "electrode": 1, "grade": "A", "reasons": [], "lat_ms": 1.0}
    located |= {"x_mm": x + 3, "y_mm": y, "z_mm": z - 4}
    second = located | {"electrode": 2, "x_mm": 0.0}
    rejected = located | {"site": "S02", "x_mm": None, "y_mm": None, "z_mm": None, "grade": "rejected"}
    rows = accuracy([located, second, rejected], truth)
    assert [row.error_mm for row in rows] == [pytest.approx(5.0), None]
    assert rms_mm(rows) == pytest.approx(5.0)
    assert rms_mm(rows[1:]) is None
