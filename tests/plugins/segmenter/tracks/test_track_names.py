"""Each catheter of the study has one track at a time."""

import numpy as np
import pytest

from fluoromap.contracts import Chain, FrameChains
from fluoromap.segmenter.judge.verdict import Verdict
from fluoromap.segmenter.tracks.track import Track
from fluoromap.segmenter.tracks.track_names import surplus
from fluoromap.segmenter.tracks.tracking import track_chains

POINTS = np.array([[0.0, 0], [20, 0], [50, 5], [70, 10]])


def chain(at, kinds, manual=False):
    return Chain((1, 2, 3, 4), POINTS + at, np.tile(np.eye(2), (4, 1, 1)), np.ones(4), kinds, manual=manual)


def track(at, kinds, frames, detections=None, manual=False):
    one = chain(at, kinds, manual)
    found = len(frames) if detections is None else detections
    return Track(one, 0.0, np.zeros(2), found, manual=manual, chains=dict.fromkeys(frames, one))


ONE = (("map", 1.0),)
EITHER = (("a", 0.5), ("b", 0.5))


@pytest.mark.parametrize(("kinds", "possible"), [(ONE, 1), (EITHER, 2)])
def test_as_many_tracks_at_one_time_as_catheters_have_the_name(kinds, possible):
    tracks = [track(100.0 * k, kinds, range(10), detections=10 - k) for k in range(4)]
    assert surplus(tracks) == tracks[possible:]


def test_tracks_of_different_times_may_be_one_catheter():
    assert surplus([track(0, ONE, range(10)), track(100, ONE, range(8, 20))]) == []


def test_a_name_that_only_one_track_can_have_is_not_given_to_another():
    sure, doubtful = track(0, (("a", 0.99), ("b", 0.01)), range(10)), track(100, EITHER, range(10), detections=20)
    assert surplus([sure, doubtful]) == []
    third = track(200, EITHER, range(10), detections=5)
    assert surplus([sure, doubtful, third]) == [third]


def test_a_track_that_was_set_by_hand_keeps_its_name():
    by_hand, found = track(0, ONE, range(3), manual=True), track(100, ONE, range(10))
    assert surplus([found, by_hand]) == [found]


def test_a_second_track_of_one_catheter_is_left_out_of_a_run():
    # Each frame's own search shows one catheter, but not always the same; the search of tracks finds both in all frames.
    frames = [FrameChains(frame, (chain(100.0 if frame % 3 == 1 else 0.0, ONE),)) for frame in range(12)]

    def search(frame, known, shift, reach_px, taken, same_shape=False, confirmed=False):
        return known

    entries = track_chains(frames, np.arange(12) * 66.7, 2, search, judge=lambda chains: Verdict(True))
    assert [[one.pixels_uv[0, 0] for one in entry.chains] for entry in entries] == [[0.0]] * 12


def test_a_catheter_that_was_followed_to_two_places_has_one_track():
    # Followed again without a wrong track, the search finds the catheter elsewhere.
    first, second, wrong, other = (chain(at, ((name, 1.0),)) for at, name in zip(
        (100.0, 300.0, 500.0, 700.0), ("map", "map", "rv", "cs"), strict=True
    ))  # fmt: skip
    rejected = []

    def search(frame, known, shift, reach_px, taken, same_shape=False, confirmed=False):
        at_first = np.allclose(known.pixels_uv, first.pixels_uv)
        return (second if rejected and at_first else known) if confirmed else None

    def judge(chains):
        is_wrong = np.allclose(chains[min(chains)].pixels_uv, wrong.pixels_uv)
        rejected.extend([True] * is_wrong)
        return Verdict(not is_wrong)

    found = [FrameChains(frame, (other,)) for frame in range(12)]
    entries = track_chains(found, np.arange(12) * 66.7, 3, search, FrameChains(0, (first, wrong)), judge, False)
    assert rejected
    assert [sorted(one.kinds[0][0] for one in entry.chains) for entry in entries] == [["cs", "map"]] * 12
