"""The short form of ``benchmarks/attack.py``: every attack is tried against a real service, and all hold."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import hostile_requests
import pytest

CAMPAIGN = Path(__file__).parent.parent.parent / "benchmarks" / "attack.py"
SHORT = {
    "wildcard-patterns", "hostile-values", "many-waiting-readers", "many-previews", "unfinished-headers",
    "readers-that-take-nothing", "readiness-writes", "token-walk", "paths-outside", "guessed-tokens", "open-behind-a-proxy",
    "stolen-cookie", "narrow-tokens",
    "foreign-host", "damaged-runs", "lost-updates", "remains-of-a-study", "unseen-requests", "shortened-trail", "endless-answers",
    "code-of-the-current-folder",
}  # fmt: skip
"""The attacks that fit into a minute. A new attack enters this list, or the long form."""


@pytest.mark.timeout(600)
def test_all_attacks_of_the_short_form_hold() -> None:
    answer = subprocess.run([sys.executable, CAMPAIGN, "--short"], capture_output=True, text=True)
    results = re.findall(r"^(?:held|FAILED) +([\w-]+) \(", answer.stdout, re.MULTILINE)
    assert set(results) == SHORT, answer.stderr
    assert answer.returncode == 0, answer.stdout


def test_short_form_has_the_listed_attacks() -> None:
    assert {name for name, attack in hostile_requests.ATTACKS.items() if attack.short} == SHORT
