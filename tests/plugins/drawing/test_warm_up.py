"""The first overlay of a process draws the letters that later overlays paste."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import pytest

from fluoromap.drawing import symbols
from fluoromap.drawing.colours import milliseconds
from fluoromap.drawing.warm_up import warm_up


def test_the_first_overlay_shows_the_labels_of_usual_times_at_both_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[int, set[str]] = defaultdict(set)
    halo_text = symbols.halo_text

    def noted(draw: Any, middle: Any, text: str, size: int, *colours: Any) -> None:
        drawn[size].add(text)
        halo_text(draw, middle, text, size, *colours)

    monkeypatch.setattr(symbols, "halo_text", noted)
    warm_up()
    assert len(drawn) == 2
    usual = {milliseconds(time_ms) for time_ms in range(-50, 171)}
    assert all(usual <= texts for texts in drawn.values())
