"""Each beat marked by the catheters' motion."""

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains, Segmentation
from fluoromap.matching.beats import is_irregular, systole_starts_ms
from fluoromap.matching.phase import cardiac_phases, phase_distance
from fluoromap.matching.run_catheters import gather

STEP_MS = 1000 / 30


def moving(starts_s: np.ndarray, n: int = 90, noise: float = 0.3, seed: int = 0) -> np.ndarray:
    """Return coordinates (n, 4) of two catheters.

    They are pulled away for 300 ms from each of these times on.
    """
    times = np.arange(n) * STEP_MS / 1000
    into = (times[:, None] - starts_s) / 0.3
    pull = np.where((into > 0) & (into < 1), np.sin(np.pi * np.clip(into, 0, 1)) ** 2, 0.0).sum(axis=1)
    rng = np.random.default_rng(seed)
    return pull[:, None] * np.array([12.0, -5.0, 7.0, 3.0]) + rng.normal(0, noise, (n, 4))


@pytest.mark.parametrize("seed", range(4))
def test_each_beat_is_marked_however_long(seed: int) -> None:
    lengths = np.random.default_rng(seed).uniform(0.45, 1.1, 6)
    starts = 0.1 + np.cumsum(lengths) - lengths[0]
    starts = starts[starts < 2.7]
    found = systole_starts_ms(moving(starts, seed=seed), STEP_MS) / 1000
    assert len(found) == len(starts)
    # To a frame, but for where within the upstroke systole is said to start.
    assert np.ptp(found - starts) < 0.04
    assert abs(np.mean(found - starts)) < 0.08


@pytest.mark.parametrize("places", [np.zeros((60, 2)), np.random.default_rng(3).normal(size=(90, 4))])
def test_without_beats_there_are_no_marks(places: np.ndarray) -> None:
    assert len(systole_starts_ms(places, STEP_MS)) == 0


def test_irregular_takes_two_beats_that_differ() -> None:
    assert not is_irregular(np.array([0.0, 900.0]))
    assert not is_irregular(np.array([0.0, 800.0, 1650.0, 2440.0]))
    assert is_irregular(np.array([0.0, 800.0, 1300.0]))
    assert not is_irregular(np.zeros(0))


def run(places: np.ndarray) -> Segmentation:
    frames = []
    for frame, place in enumerate(places):
        chains = tuple(
            Chain((1, 2), 100 + place[2 * k : 2 * k + 2] + [[0, 0], [20, 0]], np.stack([np.eye(2)] * 2), np.ones(2),
                  (("reference", 0.5),), track=k) for k in range(2)
        )  # fmt: skip
        frames.append(FrameChains(frame, chains))
    n = len(places)
    return Segmentation(tuple(frames), None, (), np.ones(n), np.arange(n) * STEP_MS)


def test_phases_follow_each_beat_of_an_irregular_rhythm() -> None:
    starts = np.array([0.2, 1.0, 1.5, 2.4])
    segmentation = run(moving(starts))
    rhythm = cardiac_phases(segmentation, gather(segmentation, None, 5.75))
    assert rhythm is not None
    assert rhythm.irregular
    times = segmentation.frame_times_ms / 1000
    inside = (times >= starts[0]) & (times < starts[-1])
    truth = np.interp(times, starts, np.arange(4))
    apart = phase_distance(rhythm.phases, truth)[inside]
    assert np.sqrt(np.mean(apart**2)) < 0.08


def test_two_beats_are_not_taken_for_one() -> None:
    # 517 ms is 15.5 frames: places repeat best after two beats.
    starts = np.arange(0.1, 2.7, 0.5167)
    segmentation = run(moving(starts))
    rhythm = cardiac_phases(segmentation, gather(segmentation, None, 5.75))
    assert rhythm is not None
    assert not rhythm.irregular
    assert np.sum(np.diff(rhythm.phases) < -0.5) == len(starts)


def test_less_than_one_beat_has_no_phase() -> None:
    segmentation = run(moving(np.array([0.3]), n=20))
    assert cardiac_phases(segmentation, gather(segmentation, None, 5.75)) is None
