"""The palettes under colour-vision deficiencies, and the copy of the palettes in the pages."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from skimage.color import rgb2lab

from fluoromap.drawing.colours import _ANCHORS_RGB, Palette, colour_map
from fluoromap.reasons import AT_BEST_C, Reason

PAGES = Path(__file__).parents[3] / "service/fluoromap_service/web/assets/map"

# G. M. Machado et al., "A physiologically-based model for simulation of color vision deficiency" (2009), severity 1.
VISIONS = {
    "normal": np.eye(3),
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
}


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("palette", ["safe", "red-early"])
def test_bands_two_steps_apart_never_look_alike(palette: Palette, vision: str) -> None:
    bands = 10
    coded = colour_map((np.arange(bands) + 0.5) / bands, palette) / 255
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.transpose(VISIONS[vision]), 0, 1)
    again = np.where(seen <= 0.0031308, seen * 12.92, 1.055 * seen ** (1 / 2.4) - 0.055)
    lab = rgb2lab(again[None])[0]
    distance = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    assert distance[np.triu_indices(bands, 2)].min() > 14


def test_pages_have_the_same_palettes() -> None:
    text = (PAGES / "colour-scale.js").read_text()
    for palette, anchors in _ANCHORS_RGB.items():
        found = re.search(rf'^  "?{palette}"?: (\[\[.*\]\]),$', text, re.M)
        assert found is not None
        assert json.loads(found[1]) == anchors.astype(int).tolist()


def test_pages_doubt_the_same_sites() -> None:
    found = re.search(r"^const DOUBTS = (\[.*\]);$", (PAGES / "site-text.js").read_text(), re.M)
    assert found is not None
    assert set(json.loads(found[1])) == {*map(str, AT_BEST_C), str(Reason.LAT_OUTLIER)}
