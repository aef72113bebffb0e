"""The gate of the segmenter: what it counts, and when it says that a state is worse."""

import numpy as np
import pytest
import segmenter_gate
from gate_strata import GateRun, strata
from memory_frames import MemoryFrames

from fluoromap.catheters import DEFAULT_CATALOGUE
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Segmentation
from fluoromap.segmenter.learned_chain.plugin import LearnedChain

TIP_FIRST = np.array([[20.0, 50.0], [34.0, 50.0], [53.0, 50.0], [63.0, 50.0]])
FAR = TIP_FIRST + np.array([0.0, 200.0])


def chain(uv: np.ndarray, name: str, probability: float, track: int) -> Chain:
    covariances = np.tile(np.eye(2), (4, 1, 1))
    return Chain((1, 2, 3, 4), uv, covariances, np.ones(4), ((name, probability),), track)


def counted(monkeypatch: pytest.MonkeyPatch, *chains: Chain) -> segmenter_gate.Counts:
    """Count a run of two frames with these chains in both.

    The mapping catheter is in the picture.
    """
    frames = tuple(FrameChains(frame, chains) for frame in range(2))
    found = Segmentation(frames, None, (), np.zeros(2), np.array([0.0, 66.7]))
    monkeypatch.setattr(LearnedChain, "segment", lambda *_: found)
    pictures = MemoryFrames([np.zeros((512, 512), np.uint16)] * 2)
    run = Run(pictures, np.array([0.0, 66.7]), 3.0, PixelFacts(False, 8, False))
    return segmenter_gate.count_run(GateRun(run, DEFAULT_CATALOGUE, [{"mapping": TIP_FIRST}] * 2))


def test_a_right_track_counts_as_found_named_and_numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = counted(monkeypatch, chain(TIP_FIRST + 0.5, "mapping", 0.99, 0))
    assert (counts.right, counts.there, counts.false, counts.named, counts.numbered) == (8, 8, 0, 1, 1)
    assert (counts.sure, counts.sure_wrong, counts.inside, counts.ellipses) == (1, 0, 8, 8)


def test_a_row_from_the_other_end_is_named_and_not_numbered(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = counted(monkeypatch, chain(TIP_FIRST[::-1], "mapping", 0.99, 0))
    assert (counts.right, counts.named, counts.numbered) == (8, 1, 0)


def test_a_track_on_nothing_is_one_false_track_and_a_sure_one_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = counted(monkeypatch, chain(FAR, "mapping", 0.96, 0), chain(FAR + 100, "reference", 0.5, 1))
    assert (counts.right, counts.false, counts.sure, counts.sure_wrong) == (0, 2, 1, 1)


def test_a_figure_is_worse_only_beyond_the_interval_and_on_its_bad_side() -> None:
    interval = (0.9, 0.85, 0.95)
    assert segmenter_gate.worse("found", 0.84, interval)
    assert not segmenter_gate.worse("found", 0.99, interval)
    assert segmenter_gate.worse("false", 0.96, interval)
    assert not segmenter_gate.worse("false", 0.5, interval)
    assert not segmenter_gate.worse("named", float("nan"), interval)


def test_all_strata_draw_runs_with_a_truth_for_each_frame() -> None:
    drawn = {
        stratum.name: stratum.draw(0) for stratum in strata(1, None) if stratum.name.startswith(("3 to 6", "list"))
    }
    assert len(drawn) == 3
    for name, one in drawn.items():
        assert len(one.truth) == len(one.run.frames), name
        assert all(set(truth) <= set(one.catalogue.names) for truth in one.truth)
