"""Frames searched one after the other: means of neighbours in noise, and shared answers of the network in fast runs."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np

from fluoromap.contracts import Chain, FrameChains
from fluoromap.reasons import Reason
from fluoromap.segmenter.electrodes.blob_response import BlobResponse
from fluoromap.segmenter.electrodes.frame_answers import LatestBlobs, LatestNetwork, StoredByFrame
from fluoromap.segmenter.electrodes.network.network_response import NetworkResponse
from fluoromap.segmenter.electrodes.proposals import Likeness, Proposals
from fluoromap.segmenter.frames import frame_search
from fluoromap.segmenter.frames.frame_search import FrameSearch
from fluoromap.segmenter.shape.chain_comparison import reverse

POINTS = np.array([[0.0, 0], [20, 0], [50, 5], [70, 10]])
X = np.zeros((32, 32), np.float32)
NONE_FOUND = Proposals(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))
ANSWER = NetworkResponse(X, np.zeros((32, 32, 5), np.float32), NONE_FOUND, 2.0, 0.0, 1.0)


def blobs_of(x):
    return BlobResponse(np.zeros((3, *x.shape), np.float32), x, np.ones(3), x, 0.01, 0.01, 1, 3.0)


def chain(shift=0.0):
    return Chain((1, 2, 3, 4), POINTS + shift, np.tile(np.eye(2), (4, 1, 1)), np.ones(4), (("reference", 1.0),))


@dataclass(frozen=True)
class Searched:
    x: np.ndarray
    seen: SimpleNamespace
    chains: tuple

    def entry(self, frame):
        return FrameChains(frame, self.chains, None if self.chains else Reason.MANUAL_NEEDED)


class Detector:
    """Shows a catheter in images of mean ``level`` only; ``likeness`` of an image is the same everywhere."""

    def __init__(self, network, level):
        self.network, self.level = network, level
        self.likeness = lambda x: 10.0
        self.searched, self.split, self.found_again = [], [], []
        self.of_pairs, self.doubtful = (), False
        self.frame, self.chain_at, self.turned_in = 0, lambda frame: 0.0, ()
        self.family = None
        self.field, self.px_per_mm = SimpleNamespace(inside=np.ones(X.shape, np.bool_)), 5.0

    def forget_image(self):
        pass

    def search(self, x):
        self.network(x)
        self.searched.append(float(x.mean()))
        found = chain(self.chain_at(self.frame))
        found = reverse(found) if self.frame in self.turned_in else found
        return Searched(x, self.image_evidence(x), (found,) if np.isclose(x.mean(), self.level) else ())

    def has_doubtful_places(self, searched):
        return self.doubtful

    def split_pairs(self, searched):
        self.split.append(float(searched.x.mean()))
        return replace(searched, chains=self.of_pairs) if self.of_pairs else searched

    def image_evidence(self, x):
        likeness = Likeness(np.full(X.shape, self.likeness(x), np.float32), 4.0, 0.0)
        return SimpleNamespace(likeness=likeness, position_noise=0.02 * float(x.mean()))

    def family_of(self, chain):
        return self.family

    def find_again(self, x, known, shift, reach_px, taken, frame=None, same_shape=False, confirmed=False):
        self.found_again.append((float(x.mean()), known))
        return chain(1.0)


def search(level, shares, near_px=0.0):
    asked = []
    network = LatestNetwork(lambda x: asked.append(float(x.mean())) or ANSWER, lambda x: SimpleNamespace(of=x))
    detector = Detector(network, level)
    return FrameSearch(detector, network, LatestBlobs(blobs_of), 1, shares, near_px), detector, asked


def test_a_frame_without_its_catheter_is_searched_in_the_mean_and_the_chain_found_again_in_the_frame():
    frames, detector, _ = search(2.0, shares=False)
    entry = frames.find_chains(X + 1, 0, [X + 2, X + 3])
    assert detector.searched == [1.0, 2.0]
    ((at, known),) = detector.found_again
    assert at == 1.0
    assert np.allclose(entry.chains[0].pixels_uv, POINTS + 1)
    # The frame is part of the mean, so the mean's place must hardly count.
    assert known.covariance_px2[0, 0, 0] > 5.0
    frames.find_chains(X + 1, 1, [X + 2, X + 3])
    assert detector.searched == [1.0, 2.0, 2.0]


def test_of_frame_and_mean_the_one_that_helped_last_is_searched_first():
    frames, detector, _ = search(2.0, shares=False)
    frames.find_chains(X + 1, 0, [X + 2, X + 3])
    detector.searched.clear()
    # In fast motion the mean shows nothing: the first such frame is searched twice, those after it once.
    detector.level = 1.0
    frames.find_chains(X + 1, 1, [X + 2, X + 3])
    assert detector.searched == [2.0, 1.0]
    frames.find_chains(X + 1, 2, [X + 2, X + 3])
    assert detector.searched == [2.0, 1.0, 1.0]


def test_a_catheter_that_only_the_neighbours_show_is_not_found_in_the_frame():
    frames, detector, _ = search(2.0, shares=False)
    detector.likeness = lambda x: 12.0 if np.isclose(x.mean(), 2.0) else 2.0
    assert frames.find_chains(X + 1, 0, [X + 2, X + 3]).chains == ()
    detector.likeness = lambda x: 12.0 if np.isclose(x.mean(), 2.0) else 7.0
    assert len(frames.find_chains(X + 1, 0, [X + 2, X + 3]).chains) == 1


def test_a_clear_frame_and_one_without_neighbours_are_searched_once():
    frames, detector, _ = search(1.0, shares=False)
    assert frames.find_chains(X + 1, 0, [X + 2, X + 3]).manual_needed is None
    assert frames.find_chains(X + 5, 1).manual_needed is Reason.MANUAL_NEEDED
    assert detector.searched == [1.0, 5.0]


def test_pairs_are_split_only_where_the_mean_does_not_show_the_catheter_either():
    frames, detector, _ = search(2.0, shares=False)
    detector.of_pairs = (chain(30.0),)
    assert np.allclose(frames.find_chains(X + 1, 0, [X + 2, X + 3]).chains[0].pixels_uv, POINTS + 1)
    assert detector.split == []
    assert np.allclose(frames.find_chains(X + 5, 1).chains[0].pixels_uv, POINTS + 30)
    assert detector.split == [5.0]


def test_pairs_are_split_where_a_chain_has_places_that_are_no_electrodes():
    frames, detector, _ = search(1.0, shares=False)
    detector.of_pairs, detector.doubtful = (chain(30.0),), True
    assert np.allclose(frames.find_chains(X + 1, 0).chains[0].pixels_uv, POINTS + 30)
    assert detector.split == [1.0]


def test_in_fast_runs_one_answer_of_the_network_serves_two_frames():
    frames, _, asked = search(1.0, shares=True)
    for frame in range(6):
        assert frames.find_chains(X + 1, frame).chains
    assert len(asked) == 3


def asked_in(frames, detector, asked, places):
    """Return the frames for which the network was asked.

    The catheter is at one of these places in each frame.
    """
    detector.chain_at = lambda frame: places[frame]
    of = []
    for frame in range(len(places)):
        detector.frame, before = frame, len(asked)
        assert frames.find_chains(X + 1, frame).chains
        of += [frame] * (len(asked) - before)
    return of


def test_an_answer_is_carried_along_with_a_catheter_until_it_moves_otherwise():
    frames, detector, asked = search(1.0, shares=False, near_px=4.0)
    places = [0.0, 0.5, 1.0, 3.0, *range(6, 40, 3), 32.0, 32.0]
    # Own answers: until the speed is known, after twelve more frames, and while the speed changes.
    assert asked_in(frames, detector, asked, places) == [0, 1, 14, 16, 17]


def test_a_carried_answer_is_asked_about_places_where_the_catheter_was_then():
    frames, detector, asked = search(1.0, shares=False, near_px=4.0)
    motions = []
    detector.forget_image = lambda: motions.append(frames.network.motion)
    assert asked_in(frames, detector, asked, [0.0, 3.0, 6.5]) == [0, 1]
    assert motions[:2] == [None, None]
    # From frame 1 on, if it moves on as from frame 0 to frame 1.
    assert np.allclose(motions[2].shifts_at(POINTS + 6.0), 3.0)
    assert np.allclose(motions[2].shifts_at(POINTS[:1] - [0, 100]), 0.0)
    assert frames.network.motion is None
    # Tracking, which may begin with detections that were stored, does not use carried answers.
    assert frames.answers.network.of_frame(2) is None


def searched_of(frames, detector, places, level=1.0):
    """Return the searched frames and all entries of a catheter at these places."""
    detector.chain_at = lambda frame: places[frame]
    of, entries = [], []
    for frame in range(len(places)):
        detector.frame, before = frame, len(detector.searched)
        entries.append(frames.find_chains(X + level, frame))
        of += [frame] * (len(detector.searched) > before)
    return of, entries


def follow_by(monkeypatch, answer):
    monkeypatch.setattr(frame_search, "follow_chains", lambda x, expected, *_: answer(expected))


def test_a_catheter_that_moves_on_is_only_fitted_in_three_of_four_frames(monkeypatch):
    frames, detector, _ = search(1.0, shares=False, near_px=4.0)
    detector.family = SimpleNamespace(catheter="reference")
    follow_by(monkeypatch, tuple)
    searched, entries = searched_of(frames, detector, [2.0 * frame for frame in range(10)])
    # Its motion is known from the third frame on, and the search must agree with it first.
    assert searched == [0, 1, 2, 6]
    for frame, entry in enumerate(entries):
        assert entry.frame == frame
        assert np.allclose(entry.chains[0].pixels_uv, POINTS + 2.0 * frame)


def test_a_frame_that_the_fit_does_not_show_is_searched(monkeypatch):
    frames, detector, _ = search(1.0, shares=False, near_px=4.0)
    detector.family = SimpleNamespace(catheter="reference")
    follow_by(monkeypatch, lambda expected: None)
    assert searched_of(frames, detector, [0.0] * 6)[0] == [0, 1, 2, 3, 4, 5]


def test_a_catheter_that_moves_otherwise_is_not_followed_at_once(monkeypatch):
    frames, detector, _ = search(1.0, shares=False, near_px=4.0)
    detector.family = SimpleNamespace(catheter="reference")
    follow_by(monkeypatch, tuple)
    # In the third frame it is not where it would be; from the fourth on it moves as before.
    assert searched_of(frames, detector, [0.0, 0, 20, 40, 60, 80, 100])[0] == [0, 1, 2, 3]


def test_a_catheter_whose_tip_seems_to_be_at_its_other_end_has_not_moved():
    frames, detector, asked = search(1.0, shares=False, near_px=4.0)
    detector.turned_in = (1, 4, 5, 7)
    motions = []
    detector.forget_image = lambda: motions.append(frames.network.motion)
    assert asked_in(frames, detector, asked, [2.0 * frame for frame in range(9)]) == [0, 1]
    assert len(motions) == 9
    # The answer of frame 1 is moved with the catheter, electrode by electrode.
    assert all(
        np.allclose(motion.shifts_at(POINTS + 2.0 * (k + 2)), 2.0 * (k + 1)) for k, motion in enumerate(motions[2:])
    )


def test_after_a_sudden_motion_the_next_frame_asks_the_network_at_once():
    frames, detector, asked = search(1.0, shares=False, near_px=4.0)
    assert asked_in(frames, detector, asked, [0.0, 0, 0, 20, 40, 60]) == [0, 1, 3, 4]
    # The fourth frame was searched with the carried answer first.
    assert len(detector.searched) == 7


def test_catheters_that_only_a_mean_showed_are_followed_with_the_noise_of_a_frame(monkeypatch):
    frames, detector, _ = search(2.0, shares=False, near_px=4.0)
    detector.family = SimpleNamespace(catheter="reference")
    noises = []
    monkeypatch.setattr(
        frame_search,
        "follow_chains",
        lambda x, expected, catheters, inside, px_per_mm, noise, reach_px: noises.append(noise) or tuple(expected),
    )
    for frame in range(7):
        assert frames.find_chains(X + 1, frame, [X + 2, X + 3]).chains
    # Frames 3, 4 and 5 are fitted; the first frame, searched without its neighbours, showed the noise of a frame.
    assert noises == [0.02] * 3
    assert len(detector.searched) == 5


def test_in_slow_runs_no_answer_is_carried():
    frames, detector, asked = search(1.0, shares=False)
    assert asked_in(frames, detector, asked, [0.0] * 4) == [0, 1, 2, 3]


def test_a_frame_that_lacks_a_catheter_has_no_share_in_another_frame_s_answer():
    frames, _, asked = search(1.0, shares=False, near_px=4.0)
    for frame in range(4):
        frames.find_chains(X + (1 if frame != 2 else 5), frame)
    assert asked == [1.0, 1.0, 5.0, 1.0]


def test_answers_for_means_are_carried_too():
    frames, _, asked = search(2.0, shares=False, near_px=4.0)
    for frame in range(5):
        assert frames.find_chains(X + 1, frame, [X + 2, X + 3]).chains
    assert asked == [1.0, 2.0, 2.0]


def test_tracking_uses_the_answers_for_frames_that_were_searched_with_their_own():
    frames, _, asked = search(2.0, shares=False)
    frames.find_chains(X + 1, 0, [X + 2, X + 3])
    frames.find_chains(X + 5, 1)
    assert asked == [1.0, 2.0, 5.0]
    again = X + 5
    frames.find_again(again, chain(), np.zeros(2), 5.0, (), 1)
    assert frames.network(again).found is NONE_FOUND
    assert asked == [1.0, 2.0, 5.0]


def test_tracking_asks_the_network_about_places_of_frames_that_have_no_answer_of_their_own():
    frames, _, asked = search(2.0, shares=False)
    x = X + 5
    frames.find_again(x, chain(), np.zeros(2), 5.0, (), 1)
    assert frames.network(x).of is x
    assert asked == []


def test_tracking_uses_the_blobs_of_frames_that_were_searched():
    frames, _, _ = search(1.0, shares=False)
    x = X + 1
    frames.blobs(x)
    frames.find_chains(x, 0)
    again = X + 1
    frames.find_again(again, chain(), np.zeros(2), 5.0, (), 0)
    assert frames.blobs(again).best is x


def test_the_mean_of_a_run_is_not_taken_for_the_frame_whose_number_it_has():
    frames, _, _ = search(1.0, shares=False)
    frames.find_chains(X + 1, 0)
    frames.find_chains(X + 9, 5)
    assert frames.answers.network.of_frame(0) is not None
    assert frames.answers.network.of_frame(5) is None


def test_stored_answers_have_a_limit():
    answers = StoredByFrame(most_bytes=ANSWER.answers.nbytes + ANSWER.probability.nbytes)
    for frame, response in enumerate((ANSWER, None, ANSWER)):
        answers.store(frame, response)
    assert [answers.of_frame(frame) is not None for frame in range(3)] == [True, False, False]


def test_stored_blobs_answer_about_places_without_the_memory_of_their_scales():
    blobs = blobs_of(X)
    stored = blobs.without_stack()
    assert stored.nbytes == blobs.best.nbytes + blobs.smooth.nbytes
    assert np.array_equal(stored.scores_at(POINTS), blobs.scores_at(POINTS))
