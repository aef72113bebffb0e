"""Reason codes."""

import pytest

from fluoromap.reasons import Reason


@pytest.mark.parametrize("reason", list(Reason))
def test_every_reason_has_a_code_and_a_sentence(reason: Reason) -> None:
    assert reason.value == reason.name.lower()
    assert reason.sentence.endswith(".")
    assert reason.sentence[0].isupper()
