"""``study.toml``: what it may say, and the message about each wrong key or value."""

from __future__ import annotations

from pathlib import Path

import pytest

from fluoromap_service.cli.failures import CommandFailed
from fluoromap_service.cli.study_file import StudyFile, read_study_file
from fluoromap_service.cli.submission import find_files

TWO_CATHETERS = (
    '[[catheters]]\nname = "cs"\ntype = "decapolar-2-5-2"\n[[catheters]]\nname = "mapping"\ntype = "ablation-4"\n'
)


def _read(folder: Path, text: str) -> StudyFile:
    path = folder / "study.toml"
    path.write_text(text)
    return read_study_file(path)


def _refusal(folder: Path, text: str) -> str:
    with pytest.raises(CommandFailed) as caught:
        _read(folder, text)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("catheter = 3", ["catheter:", "catheters, reference, gantry, sites, pipeline"]),
        ("[sites.S01]\nview_c = 'x'", ["sites.S01.view_c:", "view_a, view_b, lat_ms"]),
        ("[sites.S01]\nlat_ms = '12'", ["sites.S01.lat_ms:", "valid number"]),
        ("[sites.S01]\nlat_ms = true", ["sites.S01.lat_ms:", "valid number"]),
        ("[sites.S01]\nlat_ms = nan", ["sites.S01.lat_ms:", "finite number"]),
        ("[sites.S01]", ["sites.S01:", "view_a, view_b or lat_ms"]),
        ("[sites.'a/b']\nlat_ms = 1", ["sites.a/b:", "without a slash"]),
        ("[gantry]\nsid = 1000", ["gantry.sid:", "source_detector_mm, source_isocentre_mm, pixel_spacing_mm"]),
        ("[gantry]\nsource_detector_mm = 10", ["gantry.source_detector_mm:", "greater than or equal to"]),
        ("[gantry]\nprimary_deg = 1979-05-27", ["gantry.primary_deg:", "valid number"]),
        (TWO_CATHETERS + "tip = 4", ["catheters.number 2.tip:", "edge_spacing_mm, tip_mm, ring_mm"]),
        ("[[catheters]]\nname = 'x'\ntype = 'y'", ["catheters.number 1:", "ablation-4"]),
        ("reference = 'x'\n[[catheters]]\nname = 'x'\ntype = 'ablation-4'", ["reference:", "leave this out"]),
        ("reference = 'cs'", ["reference:", "the catheters are reference, pacing, mapping"]),
        ("[pipeline.fusers]", ["pipeline.fusers:", "segmenter, triangulator, monoplane, fuser"]),
        ("[pipeline.fuser]\nname = 'x'", ["pipeline.fuser.name:", "convex-hull, smooth-surface"]),
        ("[pipeline.fuser]\nparams = { a = 1 }", ["pipeline.fuser.params.a:", "fill_mm"]),
        ("[pipeline.fuser]\nparams = { fill_mm = -1 }", ["pipeline.fuser.params.fill_mm:", "greater than"]),
        ("a b", ["no", "line 1"]),
    ],
)
def test_a_wrong_key_or_value_is_named_with_the_allowed_ones(tmp_path: Path, text: str, parts: list[str]) -> None:
    message = _refusal(tmp_path, text)
    assert str(tmp_path / "study.toml") in message
    assert "orrect the file" in message
    for part in parts:
        assert part in message


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    message = _refusal(tmp_path, "x = 1\n[gantry]\ny = 2\n[sites.S01]\nlat_ms = 'z'")
    assert all(key in message for key in ("x:", "gantry.y:", "sites.S01.lat_ms:"))


def test_a_file_that_is_no_text_is_named(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_bytes(b"reference = '\xff'")
    with pytest.raises(CommandFailed, match=r"study\.toml is not a TOML file in UTF-8"):
        read_study_file(tmp_path / "study.toml")


def test_only_the_given_values_reach_the_service(tmp_path: Path) -> None:
    assert (StudyFile().study, StudyFile().job, StudyFile().default_gantry) == ({}, {}, {})
    text = f"reference = 'cs'\n{TWO_CATHETERS}[gantry]\npixel_spacing_mm = [0.3, 0.3]\n[pipeline.fuser]\nname = 'convex-hull'"
    study = _read(tmp_path, text)
    catheters = [{"name": "cs", "type": "decapolar-2-5-2"}, {"name": "mapping", "type": "ablation-4"}]
    assert study.study == {"catheters": catheters, "reference": "cs"}
    assert study.default_gantry == {"pixel_spacing_mm": [0.3, 0.3]}
    assert study.job == {"pipeline": {"fuser": {"name": "convex-hull"}}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder whose files only look like DICOM."""
    for name in ("one/a.dcm", "two/a.dcm", "two/b.dcm"):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(128) + b"DICM")
    (tmp_path / "activation_times.csv").write_text("site,lat_ms\nS01,1\n")
    return tmp_path


def _named_runs(folder: Path, text: str) -> list[tuple[str, str, str]]:
    (folder / "study.toml").write_text(text)
    files = find_files(folder)
    return [(named.site, named.view, files.name_of(named.run)) for named in files.named_runs]


def test_a_run_is_named_by_its_path_or_by_a_name_that_only_one_file_has(folder: Path) -> None:
    text = "[sites.S01]\nview_a = 'one/a.dcm'\nview_b = 'b.dcm'"
    assert _named_runs(folder, text) == [("S01", "view_a", "one/a.dcm"), ("S01", "view_b", "two/b.dcm")]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("[sites.S01]\nview_a = 'a.dcm'", ["sites.S01.view_a", "one/a.dcm, two/a.dcm"]),
        ("[sites.S01]\nview_b = 'c.dcm'", ["sites.S01.view_b", "one/a.dcm, two/a.dcm, two/b.dcm"]),
        ("[sites.S01]\nview_a = 'b.dcm'\n[sites.S02]\nview_b = 'two/b.dcm'", ["sites.S02.view_b", "sites.S01.view_a"]),
    ],
)
def test_a_run_that_is_not_one_file_is_refused(folder: Path, text: str, parts: list[str]) -> None:
    with pytest.raises(CommandFailed) as caught:
        _named_runs(folder, text)
    assert all(part in str(caught.value) for part in parts)


def test_the_table_may_be_absent_where_the_file_has_times(folder: Path) -> None:
    (folder / "activation_times.csv").unlink()
    with pytest.raises(CommandFailed, match="no activation-time table"):
        find_files(folder)
    (folder / "study.toml").write_text("[sites.S01]\nlat_ms = 3")
    assert find_files(folder).activation_times is None
