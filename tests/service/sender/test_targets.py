"""The targets of the configuration file, and the sentence for each mistake."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget, Target, WebhookTarget, read_targets
from fluoromap_service.problem import Problem
from fluoromap_service.settings import settings

PAGE = Path(__file__).parents[3] / "docs" / "pacs.md"

PACS = """
[targets.pacs]
kind = "dicom"
host = "192.0.2.8"
port = 104
aet = "PACS"
"""


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], tuple[Target, ...]]]:
    """Return a function that reads the targets of a configuration file with a text."""
    file = tmp_path / "fluoromap.toml"
    monkeypatch.setenv("FLUOROMAP_CONFIG", str(file))
    settings.cache_clear()

    def read_text(text: str) -> tuple[Target, ...]:
        file.write_text(text)
        return read_targets()

    yield read_text
    settings.cache_clear()


def test_example_of_the_page_has_a_target_of_each_kind(read: Callable[[str], tuple[Target, ...]]) -> None:
    example = next(part for part in PAGE.read_text().split("```toml\n") if "[targets." in part).split("```")[0]
    for content in (example, re.sub(r"^# (?=[\w.]+ = )", "", example, flags=re.M)):
        assert [(target.name, type(target)) for target in read(content)] == [
            ("pacs", CStoreTarget), ("archive", StowTarget), ("registry", WebhookTarget),
        ]  # fmt: skip


def test_table_of_the_page_has_the_defaults(read: Callable[[str], tuple[Target, ...]]) -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| `(\d+)` \|", PAGE.read_text(), re.M))
    (target,) = read(PACS)
    assert {name: float(value) for name, value in rows.items()} == {
        name: getattr(target, name)
        for name in ("timeout_seconds", "first_wait_seconds", "longest_wait_seconds", "give_up_days")
    }


def test_waits_double_up_to_the_longest(read: Callable[[str], tuple[Target, ...]]) -> None:
    (target,) = read(PACS + "first_wait_seconds = 10\nlongest_wait_seconds = 60\n")
    assert [target.wait_seconds(failures) for failures in (1, 2, 3, 4, 5, 5000)] == [10, 20, 40, 60, 60, 60]


def test_no_file_and_no_table_give_no_targets(read: Callable[[str], tuple[Target, ...]]) -> None:
    assert read("") == ()
    settings.cache_clear()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[targets.pacs\n", "fluoromap.toml cannot be used"),
        (PACS + "prot = 105\n", "targets.pacs.dicom.prot"),
        (PACS.replace('"PACS"', '"A_TITLE_OF_17_CHAR"'), "targets.pacs.dicom.aet"),
        (PACS.replace('"dicom"', '"ftp"'), "targets.pacs"),
        (PACS.replace("targets.pacs", 'targets."a b"'), "targets.a b.dicom.name"),
        (PACS + PACS, "fluoromap.toml cannot be used"),
        (PACS + "[other]\n", "unknown tables: other"),
        ("targets = 1\n", "[targets.NAME]"),
    ],
)
def test_mistakes_have_a_sentence(read: Callable[[str], tuple[Target, ...]], text: str, reason: str) -> None:
    with pytest.raises(Problem, match=re.escape(reason)):
        read(text)
