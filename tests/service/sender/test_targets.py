"""The file of targets: what it may say, and the sentence for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget, WebhookTarget, read_targets
from fluoromap_service.problem import Problem

PAGE = Path(__file__).parents[3] / "docs" / "pacs.md"

PACS = """
[[target]]
name = "pacs"
kind = "c-store"
host = "192.0.2.8"
port = 104
called_aet = "PACS"
"""


def test_example_of_the_page_is_a_file_of_targets(tmp_path: Path) -> None:
    file = tmp_path / "targets.toml"
    file.write_text(next(part for part in PAGE.read_text().split("```toml\n") if "[[target]]" in part).split("```")[0])
    assert [type(target) for target in read_targets(file)] == [CStoreTarget, StowTarget, WebhookTarget]


def test_waits_double_up_to_the_longest(tmp_path: Path) -> None:
    file = tmp_path / "targets.toml"
    file.write_text(PACS + "first_wait_seconds = 10\nlongest_wait_seconds = 60\n")
    (target,) = read_targets(file)
    assert [target.wait_seconds(failures) for failures in (1, 2, 3, 4, 5, 5000)] == [10, 20, 40, 60, 60, 60]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no table"),
        ("[[target]\n", "Expected"),
        (PACS + "prot = 105\n", "c-store.prot"),
        (PACS.replace("PACS", "A_TITLE_OF_17_CHAR"), "called_aet"),
        (PACS.replace("c-store", "ftp"), "kind"),
        (PACS + PACS, "same name"),
        (PACS + "[other]\n", "unknown tables: other"),
        ("target = 1\n", "valid list"),
    ],
)
def test_mistakes_have_a_sentence(tmp_path: Path, text: str, reason: str) -> None:
    file = tmp_path / "targets.toml"
    file.write_text(text)
    with pytest.raises(Problem, match=reason):
        read_targets(file)
