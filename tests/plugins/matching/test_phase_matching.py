"""Moments of one view brought together with those of the other."""

import numpy as np
import pytest

from fluoromap.contracts import NamedChain, Observation
from fluoromap.matching.phase_matching import NEAREST_PHASE, WIDEST_GAP, pair_by_phase


def place(phase: float) -> np.ndarray:
    return np.array([[100 + 8 * np.cos(2 * np.pi * phase), 200 + 5 * np.sin(2 * np.pi * phase)]])


def track(phases: np.ndarray, electrodes: tuple[int, ...] = (1,)) -> list[Observation]:
    def chain(phase: float) -> NamedChain:
        count = len(electrodes)
        return NamedChain(
            "mapping", electrodes, np.repeat(place(phase), count, axis=0), np.tile(np.eye(2), (count, 1, 1))
        )

    return [Observation(frame, float(phase), (chain(phase),)) for frame, phase in enumerate(phases)]


def test_the_nearest_frame_of_any_beat_is_taken_as_it_is():
    b = track(np.array([0.5, 0.98, 0.21, 0.71]))
    (pair,) = pair_by_phase(track(np.array([0.0])), b)
    assert pair.b is b[1]


@pytest.mark.parametrize("frames", [8, 9, 11, 16])
def test_few_frames_a_beat_lose_no_moment(frames):
    # Frame rate a multiple of the heart rate: the two views' frames never meet.
    a = track(np.arange(frames) / frames)
    b = track((np.arange(frames) + 0.5) / frames)
    pairs = pair_by_phase(a, b)
    assert [pair.phase for pair in pairs] == [seen.phase for seen in a]
    sagitta_px = 8 * (1 - np.cos(np.pi / frames)) + 1e-9
    for pair in pairs:
        assert pair.b.phase == pytest.approx(pair.phase, abs=NEAREST_PHASE + 1e-9)
        off = np.linalg.norm(pair.b.chains[0].pixels_uv - place(pair.b.phase))
        assert off <= sagitta_px
        # The mean of two equally good frames is better than either.
        variance = pair.b.chains[0].covariance_px2[0, 0, 0]
        assert 0.5 - 1e-9 <= variance <= 1


def test_nothing_is_made_up_across_a_wide_gap():
    gap = WIDEST_GAP + 0.02
    pairs = pair_by_phase(track(np.array([0.3 + gap / 2])), track(np.array([0.3, 0.3 + gap])))
    assert pairs == ()


def test_only_what_both_frames_show_lies_between_them():
    before, after = track(np.array([0.4]), (1, 2, 3))[0], track(np.array([0.5]), (2, 3, 4))[0]
    (pair,) = pair_by_phase(track(np.array([0.45])), [before, after])
    assert pair.b.chains[0].electrodes == (2, 3)
