"""What several searches of a run make together."""

from dataclasses import replace

import numpy as np
import pytest
from frame_sources import Frames

from fluoromap.catheters import DEFAULT_CATALOGUE, Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Segmentation, Silent
from fluoromap.segmenter.runs.hypotheses.run_search import RunSearch

PX_PER_MM = 5.0
RUN_SEARCH = "fluoromap.segmenter.runs.hypotheses.run_search"


def listed_catheters(catalogue, marks):
    run = Run(Frames(np.zeros((2, 8, 8), np.uint16)), np.arange(2) * 16.7, PX_PER_MM, PixelFacts(False, 12, False))
    return RunSearch(run, catalogue, marks, Silent(), None).listed_catheters()


@pytest.mark.parametrize("by_hand", [False, True])
def test_a_catheter_that_only_another_scale_shows_is_added(monkeypatch, by_hand):
    """Marks are followed at the stated scale; the other scale's catheter stays beside them."""
    one, other = (
        Chain((1, 2), [[10.0, v], [20.0, v]], np.tile(np.eye(2), (2, 1, 1)), np.ones(2), ((name, 1.0),))
        for name, v in zip(DEFAULT_CATALOGUE.names, (10.0, 90.0), strict=False)
    )
    marks = {0: (replace(one, manual=True),)} if by_hand else {}

    def search(run, catalogue, marks, context, trained):
        if run.px_per_mm == PX_PER_MM:
            chains = tuple(chain.on_track(0) for chain in marks.get(0, (one,)))
        else:
            assert not marks
            chains = (other.on_track(0),)
        frames = tuple(FrameChains(frame, chains) for frame in range(2))
        return Segmentation(frames, FrameChains(0, chains), (0, 1), np.zeros(2), run.frame_times_ms)

    monkeypatch.setattr(f"{RUN_SEARCH}.search_at_scale", search)
    monkeypatch.setattr(f"{RUN_SEARCH}.promising_scales", lambda run, catalogue, scales, least, trained: scales)
    found = listed_catheters(DEFAULT_CATALOGUE, marks)
    for entry in (*found.frames, found.diastole):
        assert [(chain.kinds[0][0], chain.manual) for chain in entry.chains] == [
            (DEFAULT_CATALOGUE.names[0], by_hand),
            (DEFAULT_CATALOGUE.names[1], False),
        ]


@pytest.mark.parametrize("by_hand", [False, True])
def test_a_catheter_whose_places_a_loop_took_is_found_without_the_loop(monkeypatch, by_hand):
    """It also stays where the loop is set by hand afterwards."""
    types = {"loop": "circular-10", "his": "quadripolar-2-5-2", "ablation": "ablation-4"}
    catalogue = Catalogue(tuple(catheter_type(of, name) for name, of in types.items()), "loop", "ablation")
    shown = {
        name: Chain((1, 2), [[10.0, v], [20.0, v]], np.tile(np.eye(2), (2, 1, 1)), np.ones(2), ((name, 1.0),), track)
        for track, (name, v) in enumerate({"his": 10.0, "ablation": 90.0, "loop": 170.0}.items())
    }
    loop = (replace(shown.pop("loop"), manual=True),)

    def search(run, catalogue, marks, context, trained):
        chains = (*marks.get(0, ()), shown["his"]) if "loop" in catalogue.names else tuple(shown.values())
        frames = tuple(FrameChains(frame, chains) for frame in range(2))
        return Segmentation(frames, FrameChains(0, chains), (0, 1), np.zeros(2), run.frame_times_ms)

    monkeypatch.setattr(f"{RUN_SEARCH}.search_at_scale", search)
    monkeypatch.setattr(f"{RUN_SEARCH}.promising_scales", lambda *_: ())
    found = listed_catheters(catalogue, {0: loop} if by_hand else {})
    for entry in (*found.frames, found.diastole):
        assert [chain.kinds[0][0] for chain in entry.chains] == [*(["loop"] if by_hand else []), "his", "ablation"]
