"""Wider ellipses of tracks whose shape jitters by more than their ellipses say."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.places.ellipse import with_jitter

PX_PER_MM = 4.0
FRAMES = 40
STATED_PX = 0.2
ARC_MM = np.cumsum([0.0, 3.0, 6.0, 3.0, 6.0, 3.0, 6.0, 3.0, 6.0, 3.0])


def bent(frame: int) -> np.ndarray:
    """Return the electrodes of a catheter that beats, (electrodes, 2).

    It moves, turns, bends and is foreshortened.
    """
    phase = 2.0 * np.pi * frame / 30.0
    bend, turn = 0.02 + 0.004 * np.sin(phase), 0.15 * np.sin(phase + 1.0)
    angle = bend * ARC_MM
    shape = np.stack([np.sin(angle), (1.0 - np.cos(angle)) * (0.8 + 0.1 * np.cos(phase))], axis=1) / bend
    turned = shape @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return PX_PER_MM * (turned + np.array([8.0 * np.sin(phase), 3.0 * np.cos(phase)])) + 200.0


def along_and_across(places: np.ndarray) -> np.ndarray:
    along = np.gradient(places, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=1)], axis=1)


def chain_of(places: np.ndarray, track: int = 0, manual: bool = False) -> Chain:
    count = len(places)
    covariance = np.tile(STATED_PX**2 * np.eye(2), (count, 1, 1))
    return Chain(
        tuple(range(1, count + 1)), places, covariance, np.ones(count), (("catheter", 1.0),), manual=manual, track=track
    )


def run_of(along_px: float, across_px: float, seed: int = 0, electrodes: int = 10) -> list[FrameChains]:
    """Return a track with such errors; all ellipses state 0.2 px."""
    random = np.random.default_rng(seed)
    entries = []
    for frame in range(FRAMES):
        truth = bent(frame)[:electrodes]
        error = random.normal(size=(electrodes, 2)) * [along_px, across_px]
        entries.append(FrameChains(frame, (chain_of(truth + np.einsum("na,nai->ni", error, along_and_across(truth))),)))
    return entries


def stated(chain: Chain) -> np.ndarray:
    """Return the mean standard deviations along the catheter and across it, (2,)."""
    axes = along_and_across(chain.pixels_uv)
    return np.sqrt(np.einsum("nai,nij,naj->na", axes, chain.covariance_px2, axes).mean(axis=0))


@pytest.mark.parametrize(("along", "across"), [(0.2, 0.2), (0.8, 0.2), (0.2, 0.8), (0.6, 1.0)])
def test_ellipses_become_as_large_as_the_errors(along, across):
    entries, _ = with_jitter(run_of(along, across), (), PX_PER_MM)
    for entry in entries:
        assert stated(entry.chains[0]) == pytest.approx([along, across], rel=0.15)


@pytest.mark.parametrize("seed", range(3))
def test_short_catheters_too(seed):
    entries, _ = with_jitter(run_of(0.2, 0.8, seed, electrodes=4), (), PX_PER_MM)
    assert stated(entries[5].chains[0]) == pytest.approx([0.2, 0.8], rel=0.3)


def test_smaller_errors_do_not_shrink_ellipses():
    run = run_of(0.05, 0.05)
    entries, _ = with_jitter(run, (), PX_PER_MM)
    for before, after in zip(run, entries, strict=True):
        np.testing.assert_array_equal(before.chains[0].covariance_px2, after.chains[0].covariance_px2)


def test_motion_turning_and_foreshortening_are_no_jitter():
    entries, _ = with_jitter(run_of(0.0, 0.0), (), PX_PER_MM)
    assert stated(entries[7].chains[0]) == pytest.approx([STATED_PX, STATED_PX])


def test_the_chain_at_diastole_grows_as_its_track_does():
    diastole = chain_of(bent(4)), chain_of(bent(4) + 80.0, track=1)
    _, (wider, other) = with_jitter(run_of(0.2, 0.8), diastole, PX_PER_MM)
    assert stated(wider) == pytest.approx([0.2, 0.8], rel=0.15)
    np.testing.assert_array_equal(other.covariance_px2, diastole[1].covariance_px2)


def test_marks_keep_their_ellipses_and_say_nothing_about_others():
    run = run_of(0.0, 0.0)
    by_hand = [
        replace(entry, chains=(replace(run_of(3.0, 3.0, 1)[entry.frame].chains[0], manual=True),))
        if entry.frame % 5 == 2
        else entry
        for entry in run
    ]
    entries, _ = with_jitter(by_hand, (), PX_PER_MM)
    for entry in entries:
        assert stated(entry.chains[0]) == pytest.approx([STATED_PX, STATED_PX])


@pytest.mark.parametrize("frames", [range(1), range(4), range(0, FRAMES, 2)])
def test_too_few_successive_frames_say_nothing(frames):
    run = run_of(1.0, 1.0)
    few = [entry if entry.frame in frames else replace(entry, chains=()) for entry in run]
    entries, _ = with_jitter(few, (), PX_PER_MM)
    for before, after in zip(few, entries, strict=True):
        assert [chain.covariance_px2.tolist() for chain in before.chains] == [
            chain.covariance_px2.tolist() for chain in after.chains
        ]


def test_a_catheter_with_two_electrodes_or_one_place_is_no_error():
    pairs = [FrameChains(frame, (chain_of(bent(frame)[:2]),)) for frame in range(FRAMES)]
    same = [FrameChains(frame, (chain_of(np.full((4, 2), 50.0)),)) for frame in range(FRAMES)]
    for run in (pairs, same):
        entries, _ = with_jitter(run, (), PX_PER_MM)
        assert all(np.isfinite(entry.chains[0].covariance_px2).all() for entry in entries)
