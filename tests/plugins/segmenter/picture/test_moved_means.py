"""Means of frames that are moved along velocities, and catheters that only they show."""

from dataclasses import replace

import numpy as np
import pytest
from frame_sources import Frames

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Silent
from fluoromap.segmenter.learned_chain.plugin import LearnedChain
from fluoromap.segmenter.picture.moved_means import moved_means
from fluoromap.segmenter.tracks.hidden_catheters import add_hidden_catheters

PX_PER_MM = 3.5
FRAMES = 16
CATALOGUE = Catalogue(
    (catheter_type("decapolar-2-5-2", "cs"), catheter_type("ablation-4", "ablation")), "cs", "ablation"
)


def test_the_mean_with_the_velocity_of_a_spot_shows_it_whole():
    times = np.arange(9) * 1000 / 60
    images = []
    for frame in range(9):
        x = np.zeros((64, 64), np.float32)
        x[30, 30 + 2 * (frame - 4) // 2] = 1.0
        images.append(x)
    # The outermost frame has moved by 4 px: the first ring of velocities.
    means = list(moved_means(images, times, 4, 4 / 0.9))
    peaks = [float(mean[30, 30]) for mean in means]
    assert len(means) == 19
    assert np.isclose(max(peaks), 1.0)
    assert sorted(peaks)[-2] < 0.7
    assert all(mean.shape == (64, 64) for mean in means)


def hidden_run(photons=4.5, through_ring=0.7):
    """Return noisy frames of a moving decapolar catheter.

    Its electrodes (frames, 10, 2) are returned too; they move 1.5 px a frame.
    """
    random = np.random.default_rng(2)
    cs = CATALOGUE["cs"]
    v, u = np.mgrid[0:256, 0:256].astype(np.float64)
    direction = np.array([np.cos(0.6), np.sin(0.6)])
    frames, truth = [], []
    for frame in range(FRAMES):
        tip = np.array([60.0 + 1.2 * frame, 70.0 + 0.9 * frame])
        along = (u - tip[0]) * direction[0] + (v - tip[1]) * direction[1]
        across = (v - tip[1]) * direction[0] - (u - tip[0]) * direction[1]
        passed = np.where((np.abs(across) < 3.0) & (along > 0), 0.9, 1.0)
        arcs = cs.arc_lengths_mm * PX_PER_MM
        for index, arc in enumerate(arcs):
            half = 0.5 * PX_PER_MM * (cs.tip_mm if index == 0 else cs.ring_mm)
            passed = np.where((np.abs(along - arc) < half) & (np.abs(across) < 3.5), through_ring, passed)
        frames.append(random.poisson(photons * passed).astype(np.uint16))
        truth.append(tip + arcs[:, None] * direction)
    return frames, np.array(truth)


@pytest.mark.parametrize("marked", [None, 2, 4, 11])
def test_a_catheter_that_noise_hides_in_every_frame_is_found(marked):
    frames, truth = hidden_run()
    run = Run(Frames(frames), np.arange(FRAMES) * 1000 / 60, PX_PER_MM, PixelFacts(False, 12, False))
    marks = {} if marked is None else {marked: (mark_far_from_all(),)}
    found = LearnedChain().segment(run, CATALOGUE, marks, Silent())
    right = [
        chain
        for entry in found.frames
        for chain in entry.chains
        if len(chain.electrodes) >= 9
        and np.mean(np.linalg.norm(chain.pixels_uv[:, None] - truth[entry.frame], axis=2).min(axis=0) <= 5.0) > 0.7
    ]
    assert len(right) >= FRAMES - 4
    assert sum(chain.manual for entry in found.frames for chain in entry.chains) == len(marks)


def mark_far_from_all():
    """Return an ablation catheter marked by hand, away from the hidden catheter."""
    points = np.array([30.0, 230.0]) + np.outer(CATALOGUE["ablation"].arc_lengths_mm * PX_PER_MM, [1.0, 0.0])
    return Chain((1, 2, 3, 4), points, np.tile(np.eye(2), (4, 1, 1)), np.ones(4), (("ablation", 1.0),), manual=True)


def chain(electrodes, at, track=-1):
    points = np.stack([at + 20.0 * np.arange(electrodes), np.full(electrodes, 50.0)], axis=1)
    numbers = tuple(range(1, electrodes + 1))
    name = "cs" if electrodes == 10 else "ablation"
    return Chain(
        numbers, points, np.tile(np.eye(2), (electrodes, 1, 1)), np.ones(electrodes), ((name, 1.0),), track=track
    )


def entries(*chains):
    return tuple(FrameChains(frame, chains) for frame in range(8))


def test_a_run_with_all_catheters_is_not_searched():
    tracked = entries(chain(10, 0.0, 0), chain(4, 400.0, 1))
    assert add_hidden_catheters(tracked, tracked, CATALOGUE, 3.5, None, None) == tracked


def test_a_longer_catheter_replaces_the_track_of_its_part():
    part, whole = chain(4, 40.0, 0), chain(10, 0.0)
    started = []

    def follow(found, start):
        started.append((found, start))
        return entries(chain(10, 0.0, 0))

    known = entries(part)
    tracked = add_hidden_catheters(known, known, CATALOGUE, 3.5, lambda frame: [whole], follow)
    assert [len(chain.electrodes) for entry in tracked for chain in entry.chains] == [10] * 8
    found, start = started[0]
    assert start.frame == 2
    assert start.chains == (whole,)
    assert all(entry.chains == () for entry in found)


def test_a_track_with_a_mark_is_not_replaced():
    marked = replace(chain(4, 40.0, 0), manual=True)
    known = entries(marked)
    assert add_hidden_catheters(known, known, CATALOGUE, 3.5, lambda frame: [chain(10, 0.0)], None) is known


def test_a_search_after_which_fewer_electrodes_are_tracked_changes_nothing():
    known = entries(chain(4, 400.0, 0))
    tracked = add_hidden_catheters(
        known, known, CATALOGUE, 3.5, lambda frame: [chain(10, 0.0)], lambda found, start: entries()
    )
    assert tracked is known


def test_a_start_that_shows_another_catheter_helps_too():
    known, more = entries(chain(4, 400.0, 0)), entries(chain(4, 400.0, 0), chain(10, 0.0, 1))
    tracked = add_hidden_catheters(
        known, known, CATALOGUE, 3.5, lambda frame: [chain(10, 150.0)], lambda found, start: more
    )
    assert tracked is more
