"""``fluoromap run`` and its ``--dry-run`` over folders, each on a real private service."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

from program import Program, one_sentence
from small_runs import edited, small_run

PAGE = Path(__file__).parents[3] / "docs" / "your-data.md"
ORDER = "site,lat_ms\nbase,-12\napex,31\n"


def _pairs(folder: Path, **attributes: object) -> Path:
    """Write two pairs of runs whose names do not sort by time."""
    folder.mkdir()
    for number, (name, angle) in enumerate({"d": 90.0, "b": 0.0, "c": 90.0, "a": 0.0}.items(), start=1):
        (folder / f"{name}.dcm").write_bytes(edited(small_run(folder, number, angle), **attributes))
    return folder


def _rows(table: str) -> dict[str, str]:
    """Return the rows of the printed table, site -> text of its lines."""
    rows: dict[str, str] = {}
    name = ""
    for line in table.splitlines():
        if match := re.match(r"  ?(pair \d+|\S+) +\S+\.dcm|  ?(\S+) +- +- ", line):
            name = match[1] or match[2]
        if name and line.strip():
            rows[name] = rows.get(name, "") + line + "\n"
        elif not line.strip():
            name = ""
    return rows


def _printed_toml(output: str) -> str:
    return "\n".join(re.findall(r"^(?:\[sites\..*\]|view_[ab] = .*)$", output, re.M)) + "\n"


def test_the_example_of_the_page_binds_a_simulated_study(
    fluoromap: Program, simulated_study: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "study"
    shutil.copytree(simulated_study, folder)
    table = folder / "activation_times.csv"
    table.write_text("".join(line for line in table.read_text().splitlines(True) if not line.startswith("S05")))
    examples = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    assert len(examples) == 1
    (folder / "study.toml").write_text(examples[0])
    answer = fluoromap("run", "study", "--dry-run")
    assert (answer.returncode, answer.stderr) == (0, "")
    assert "5 of 5 sites are ready" in answer.stdout
    rows = _rows(answer.stdout)
    assert list(rows) == ["S01", "S02", "S03", "S04", "S05"]
    assert [next(rule for rule in ("explicit", "csv") if rule in row) for row in rows.values()] == [
        "explicit", "csv", "csv", "csv", "explicit",
    ]  # fmt: skip
    assert all(
        part in rows["S05"] for part in ("dicom/S05-a.dcm", "dicom/S05-b.dcm", "90 deg", "12.5", "LAO 90.0, CRA 0.0")
    )
    assert not (folder / "results").exists()


def test_a_guess_by_order_is_shown_and_its_lines_confirm_it(fluoromap: Program, tmp_path: Path) -> None:
    folder = _pairs(tmp_path / "study")
    (folder / "activation_times.csv").write_text(ORDER)
    guess = fluoromap("run", "study", "--dry-run", "--data-dir", "kept")
    assert guess.returncode == 0
    assert (tmp_path / "kept" / "api.log").exists()
    assert not (tmp_path / "kept" / "worker.log").exists(), "nothing is computed, so nobody waits for a worker"
    rows = _rows(guess.stdout)
    assert all("order" in row and "paired_by_order" in row for row in rows.values())
    assert "paired_by_order: The site's runs are a guess" in guess.stdout
    lines = _printed_toml(guess.stdout)
    assert lines == (
        '[sites.base]\nview_a = "d.dcm"\nview_b = "b.dcm"\n[sites.apex]\nview_a = "c.dcm"\nview_b = "a.dcm"\n'
    )
    (folder / "study.toml").write_text(lines)
    confirmed = fluoromap("run", "study", "--dry-run")
    assert confirmed.returncode == 0
    assert "explicit" in confirmed.stdout
    assert "paired_by_order" not in confirmed.stdout
    assert "[sites." not in confirmed.stdout


def test_rows_and_pairs_that_do_not_agree_are_refused_with_the_files(fluoromap: Program, tmp_path: Path) -> None:
    folder = _pairs(tmp_path / "study")
    (folder / "activation_times.csv").write_text(f"{ORDER}septum,4\n")
    answer = fluoromap("run", "study")
    message = one_sentence(answer)
    assert "3 sites have an activation time but no run, and 2 pairs of runs have no site" in message
    assert "study.toml" in message
    rows = _rows(answer.stdout)
    assert list(rows) == ["base", "apex", "septum", "pair 1", "pair 2"]
    assert "d.dcm" in rows["pair 1"]
    assert '[sites.NAME_OF_PAIR_1]\nview_a = "d.dcm"\nview_b = "b.dcm"\n' in _printed_toml(answer.stdout)


def test_the_default_geometry_completes_headers(fluoromap: Program, tmp_path: Path) -> None:
    folder = _pairs(tmp_path / "study", DistanceSourceToDetector=None)
    (folder / "activation_times.csv").write_text(ORDER)
    incomplete = fluoromap("run", "study", "--dry-run")
    assert "[gantry] in study.toml: source_detector_mm" in one_sentence(incomplete)
    assert "view_a: DistanceSourceToDetector" in incomplete.stdout
    (folder / "study.toml").write_text("[gantry]\nsource_detector_mm = 700\n")
    assert "gantry does not fit a run's header" in one_sentence(fluoromap("run", "study", "--dry-run"))
    (folder / "study.toml").write_text("[gantry]\nsource_detector_mm = 1000\n")
    assert "2 of 2 sites are ready" in fluoromap("run", "study", "--dry-run").stdout


def test_a_time_in_two_places_is_refused(fluoromap: Program, tmp_path: Path) -> None:
    folder = _pairs(tmp_path / "study")
    (folder / "activation_times.csv").write_text(ORDER)
    (folder / "study.toml").write_text("[sites.base]\nlat_ms = -12\n")
    assert "sites.base.lat_ms" in one_sentence(fluoromap("run", "study", "--dry-run"))


def test_a_run_uses_the_plugins_and_ends_with_the_warning(
    fluoromap: Program, simulated_study: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "study"
    shutil.copytree(simulated_study / "dicom", folder)
    rows = [line.split(",")[:2] for line in (simulated_study / "activation_times.csv").read_text().splitlines()]
    (folder / "activation_times.csv").write_text("".join(f"{site},{time}\n" for site, time in rows))
    (folder / "study.toml").write_text('[pipeline.fuser]\nname = "convex-hull"\nparams = { fill_mm = 9.0 }\n')
    answer = fluoromap("run", "study", "--out", "maps")
    assert answer.returncode == 0, answer.stderr
    assert "(paired_by_order)" in answer.stdout
    assert '[sites.S05]\nview_a = "S05-a.dcm"\nview_b = "S05-b.dcm"\n' in _printed_toml(answer.stdout)
    fuser = json.loads((tmp_path / "maps" / "parameters.json").read_text())["fuser"]
    assert (fuser["name"], fuser["params"]["fill_mm"]) == ("convex-hull", 9.0)
