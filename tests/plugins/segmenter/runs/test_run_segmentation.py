"""Chains of a run's frames and of its diastolic mean become one answer."""

from dataclasses import replace

import numpy as np
import pytest

from fluoromap.catheters import Catalogue, catheter_type
from fluoromap.contracts import Chain, FrameChains, PixelFacts, Run, Silent
from fluoromap.segmenter.judge.verdict import Verdict
from fluoromap.segmenter.runs import final_ellipses, recalled_searches
from fluoromap.segmenter.runs.run_segmentation import segment_run
from fluoromap.segmenter.shape.chain_comparison import reverse

CATALOGUE = Catalogue((catheter_type("quadripolar-2-5-2", "reference"),), None, "reference")
LONG = Catalogue((catheter_type("decapolar-2-5-2", "cs"), catheter_type("hexapolar-2-5-2", "his")), "cs", "his")
PLACES = np.array([[40.0, 40], [50, 44], [68, 50], [78, 55]])


class Frames:
    shape = (128, 128)

    def __init__(self, count):
        random = np.random.default_rng(2)
        self.frames = random.poisson(600, (count, *self.shape)).astype(np.uint16)

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]

    def __iter__(self):
        return iter(self.frames)


def chain(tip_odds):
    return Chain(
        (1, 2, 3, 4), PLACES, np.tile(np.eye(2), (4, 1, 1)), np.ones(4), (("reference", 1.0),), tip_odds=tip_odds
    )


class Detector:
    """Finds the same catheter in each frame, and in the mean, which follows them, with its tip at the other end."""

    def __init__(self, count):
        self.count, self.searched, self.fitted = count, 0, []

    def find_chains(self, x, frame, beside=()):
        self.searched += 1
        return FrameChains(frame, (chain(1.0) if self.searched <= self.count else reverse(chain(-0.2)),))

    def find_again(self, x, known, shift, reach_px, taken, frame=None, same_shape=False, confirmed=False):
        if frame is None:
            self.fitted.append(known)
        return known

    def find_moving(self, images, times_ms, middle, frame):
        return ()

    def shows_extra_catheter(self, x, chains):
        return False


def test_the_mean_of_a_run_has_its_tip_where_the_frames_have_it():
    frames = Frames(12)
    run = Run(frames, np.arange(12) * 33.0, 4.0, PixelFacts(False, 12, False))
    detector = Detector(12)
    found = segment_run(run, CATALOGUE, {}, Silent(), lambda field: detector, True, True, lambda *_: Verdict(True))
    (diastolic,) = found.diastole.chains
    assert np.array_equal(diastolic.pixels_uv, PLACES)
    assert {each.track for entry in found.frames for each in entry.chains} == {diastolic.track}
    # It was fitted again in that direction: a tip is longer than a ring.
    assert any(np.array_equal(known.pixels_uv, PLACES) for known in detector.fitted)


class DisplacedMean(Detector):
    """Finds the catheter displaced in the mean, and in these frames."""

    def __init__(self, count, displaced):
        super().__init__(count)
        self.displaced = displaced

    def find_chains(self, x, frame, beside=()):
        self.searched += 1
        there = self.searched > self.count or frame in self.displaced
        return FrameChains(frame, (replace(chain(1.0), pixels_uv=PLACES + np.array([0.0, 14.0 * there])),))


def test_a_chain_of_the_mean_belongs_to_a_track_where_most_of_its_frames_show_it():
    run = Run(Frames(12), np.arange(12) * 33.0, 4.0, PixelFacts(False, 12, False))

    def segmented(displaced):
        detector = DisplacedMean(12, displaced)
        return segment_run(run, CATALOGUE, {}, Silent(), lambda field: detector, True, True, lambda *_: Verdict(True))

    averaged = segmented(()).diastole_frames
    assert len(averaged) >= 3
    (there,) = segmented(averaged).diastole.chains
    assert np.array_equal(there.pixels_uv, PLACES + np.array([0.0, 14.0]))
    # Where one frame shows it there, the others' chain is searched in the mean instead.
    found = segmented(averaged[:1])
    (usual,) = found.diastole.chains
    assert np.array_equal(usual.pixels_uv, PLACES)
    assert {each.track for entry in found.frames for each in entry.chains} == {usual.track}


class ShorterInMean(Detector):
    """Finds a decapolar catheter in the frames, and six of its electrodes as a hexapolar one in the mean."""

    def find_chains(self, x, frame, beside=()):
        self.searched += 1
        catheter = LONG["cs" if self.searched <= self.count else "his"]
        places = np.stack([10.0 + 2.0 * catheter.arc_lengths_mm, 40.0 + 0.5 * catheter.arc_lengths_mm], axis=1)
        numbers = tuple(range(1, catheter.electrodes + 1))
        covariance = np.tile(np.eye(2), (len(numbers), 1, 1))
        found = Chain(numbers, places, covariance, np.ones(len(numbers)), ((catheter.name, 1.0),), tip_odds=1.0)
        return FrameChains(frame, (found,))


def test_a_chain_of_the_mean_belongs_to_no_track_of_a_catheter_with_other_electrodes():
    run = Run(Frames(12), np.arange(12) * 33.0, 2.0, PixelFacts(False, 12, False))
    detector = ShorterInMean(12)
    found = segment_run(run, LONG, {}, Silent(), lambda field: detector, True, True, lambda *_: Verdict(True))
    for entry in (*found.frames, found.diastole):
        for each in entry.chains:
            assert {name for name, _ in each.kinds} == {"cs" if len(each.electrodes) == 10 else "his"}
    (diastolic,) = found.diastole.chains
    assert len(diastolic.electrodes) == 10


class Moving(Detector):
    """Finds the catheter farther down in each frame, and nothing in the mean of several."""

    def __init__(self, count, step):
        super().__init__(count)
        self.step = step

    def find_chains(self, x, frame, beside=()):
        self.searched += 1
        if self.searched > self.count:
            return FrameChains(frame, ())
        return FrameChains(frame, (replace(chain(1.0), pixels_uv=PLACES + np.array([0.0, self.step * frame])),))


def test_frames_in_which_a_catheter_lies_elsewhere_are_not_averaged():
    run = Run(Frames(3), np.arange(3) * 66.7, 4.0, PixelFacts(False, 12, False))

    def segmented(step):
        detector = Moving(3, step)
        return segment_run(run, CATALOGUE, {}, Silent(), lambda field: detector, True, True, lambda *_: Verdict(True))

    # The frames show noise alone, so that all of them are quiet.
    assert len(segmented(0.5).diastole_frames) >= 2
    (alone,) = segmented(7.0).diastole_frames
    (diastolic,) = segmented(7.0).diastole.chains
    assert np.array_equal(diastolic.pixels_uv, PLACES + np.array([0.0, 7.0 * alone]))


class Row(Detector):
    """Finds a decapolar catheter in each frame, and nothing in the mean."""

    def find_chains(self, x, frame, beside=()):
        self.searched += 1
        if self.searched > self.count:
            return FrameChains(frame, ())
        return FrameChains(frame, (row(30.0),))


def row(down):
    places = np.stack([np.linspace(20.0, 100.0, 10), np.full(10, down)], axis=1)
    covariance = np.tile(np.eye(2), (10, 1, 1))
    return Chain(tuple(range(1, 11)), places, covariance, np.ones(10), (("cs", 1.0),))


@pytest.mark.parametrize(("log_odds", "judged_again"), [(0.2, True), (3.0, False)])
def test_a_long_row_that_is_not_clear_is_judged_where_its_rings_are_fitted(monkeypatch, log_odds, judged_again):
    catalogue = Catalogue((catheter_type("decapolar-2-5-2", "cs"),), None, "cs")
    run = Run(Frames(6), np.arange(6) * 66.7, 2.0, PixelFacts(False, 12, False))
    fitted, judged = row(32.0), []

    def place(x, chains, catalogue, px_per_mm):
        return tuple(replace(one, pixels_uv=fitted.pixels_uv) for one in chains)

    def judge(chains, log_image, recall):
        there = all(np.array_equal(one.pixels_uv, fitted.pixels_uv) for one in chains.values())
        judged.append(there)
        return Verdict(log_odds >= 1.0 or there, max(log_odds, 1.5 * there))

    for module in (recalled_searches, final_ellipses):
        monkeypatch.setattr(module, "place_obliquely", place)
    detector = Row(6)
    found = segment_run(run, catalogue, {}, Silent(), lambda field: detector, True, False, judge, oblique=True)
    assert [len(entry.chains) for entry in found.frames] == [1] * 6
    assert any(judged) == judged_again


class HiddenInSomeFrames(Detector):
    """Finds the catheter in most frames; the others need a second search."""

    def find_chains(self, x, frame, beside=()):
        return FrameChains(frame, () if frame in (2, 9) else (chain(1.0),))

    def find_again(self, x, known, shift, reach_px, taken, frame=None, same_shape=False, confirmed=False):
        if frame is not None:
            self.fitted.append(frame)
        return known


class Remembering(Silent):
    """Remembers the partial results that depend on the run alone."""

    def __init__(self):
        self.results = {}

    def recall(self, kind, inputs, compute):
        if len(inputs) > 1:
            return compute()
        if kind not in self.results:
            self.results[kind] = compute()
        return self.results[kind]


def test_a_correction_searches_no_frame_again_in_which_the_run_without_it_shows_the_catheter():
    run = Run(Frames(12), np.arange(12) * 33.0, 4.0, PixelFacts(False, 12, False), content="run")
    context = Remembering()

    def segmented(marks):
        detector = HiddenInSomeFrames(12)
        found = segment_run(
            run, CATALOGUE, marks, context, lambda field: detector, True, True, lambda *_: Verdict(True)
        )
        return found, detector.fitted

    found, searched = segmented({})
    assert sorted(set(searched)) == [2, 9]
    assert all(len(entry.chains) == 1 for entry in found.frames)
    corrected = replace(chain(None), pixels_uv=PLACES + 1.0, kinds=(("reference", 1.0),))
    again, searched = segmented({5: (corrected,)})
    assert searched == []
    assert all(len(entry.chains) == 1 for entry in again.frames)
    assert len({each.track for entry in again.frames for each in entry.chains}) == 1
    (by_hand,) = again.frames[5].chains
    assert by_hand.manual
    assert np.array_equal(by_hand.pixels_uv, PLACES + 1.0)


def test_a_mark_brings_back_detections_of_a_catheter_that_the_run_did_not_accept():
    run = Run(Frames(12), np.arange(12) * 33.0, 4.0, PixelFacts(False, 12, False))

    def segmented(marks):
        detector = Detector(12)
        return segment_run(
            run, CATALOGUE, marks, Silent(), lambda field: detector, True, True, lambda *_: Verdict(False)
        )

    assert not any(entry.chains for entry in segmented({}).frames)
    found = segmented({5: (chain(None),)})
    assert all(len(entry.chains) == 1 for entry in found.frames)
